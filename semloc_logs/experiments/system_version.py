"""The version of a system: a hash of its module and of everything of ours that it imports."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import semloc_logs
from semloc_logs.benchmarks.versions import SUFFIXES, files_version

_ROOT = Path(semloc_logs.__file__).parent
_PACKAGE = "semloc_logs"
_LISTS = ("semloc_logs.experiments.systems.catalogue",)  # rows of others do not change a system


def module_version(module: str) -> str:
    """The version of a module, by its full name."""
    return files_version(sorted(_files_of(module)))


def _files_of(module: str) -> set[Path]:
    """The files that a module consists of, directly and by its imports; data files of a package
    such as weights count with its modules.
    """
    sources: set[Path] = set()
    left = [module]
    while left:
        path = _path(left.pop())
        if path is None or path in sources:
            continue
        sources.add(path)
        left += _imports(path)
    folders = {path.parent for path in sources} - {_ROOT}
    data = {
        file
        for folder in folders
        for file in folder.glob("*/*")
        if file.suffix in SUFFIXES and file.suffix != ".py"
    }
    return sources | data


@cache
def _imports(path: Path) -> tuple[str, ...]:
    """The modules of ours that a file names, also inside functions."""
    out = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            out += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            out += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return tuple(name for name in out if name.startswith(f"{_PACKAGE}."))


def _path(module: str) -> Path | None:
    """The file of a module of ours, or of a package; None for a list of systems or another name."""
    if module in _LISTS:
        return None
    place = _ROOT.joinpath(*module.split(".")[1:])
    files = (place.with_suffix(".py"), place / "__init__.py")
    return next((path for path in files if path.is_file()), None)

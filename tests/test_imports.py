"""One import direction, read from the source: a module imports only modules before it in the
story.
"""

import ast
import subprocess
import sys
from collections.abc import Iterator, Sequence
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from semloc_logs.cli.main import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
# rooms in the order of the story; a room imports only rooms above it
ORDER = [
    "errors",
    "arrays",
    "progress",
    "schemas",
    "settings",
    "workspace",
    "numerics",
    "tables",
    "frames",
    "logs",
    "labels",
    "voxels",
    "mapping",
    "subvolumes",
    "words",
    "alignment",
    "closures",
    "pose_graph",
    "pictures",
    "exports",
    "report_page",
    "engines",
    "stages",
    "simulation",
    "training",
    "evaluation",
    "benchmarks",
    "experiments",
    "api",
]
# sub-rooms and modules of a room that stands in an order of its own; the others stand last
INNER_ORDER = {
    "settings": ["sections", "configuration", "sources"],
    "logs": [
        "problems",
        "remote",
        "log",
        "topic_pairs",
        "role_types",
        "roles",
        "messages",
        "containers",
        "poses",
        "sensors",
        "session",
        "inspection",
        "annotation",
    ],
    "simulation": [
        "conditions",
        "meshes",
        "town",
        "sensors",
        "drives",
        "output",
        "drive_plan",
        "sessions",
        "demo",
    ],
    "benchmarks": [
        "spans",
        "versions",
        "scans",
        "fused_sessions",
        "peers",
        "descriptors",
        "labels",
        "localisation",
        "speed",
        "named",
    ],
    "alignment": [
        "hypotheses",
        "mask_grid",
        "tau",
        "cell_masks",
        "overlaps",
        "surface",
        "icp",
        "query_map",
        "target_map",
        "scores",
        "search",
        "level_ground",
        "refine",
        "covariance",
    ],
    "closures": [
        "closure",
        "query",
        "acceptance",
        "closure_tables",
        "alignment_tables",
        "tracks",
        "session_pairs",
        "recent",
        "database",
        "visibility",
        "target_surface",
        "matching",
        "search_tasks",
    ],
}
SOURCES = sorted((ROOT / "semloc_logs").rglob("*.py"))
CLI = sorted((ROOT / "cli").rglob("*.py"))


def _imports(path: Path) -> Iterator[tuple[str, int]]:
    """Absolute names of imported modules and the number of leading dots."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((name.name, 0) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or "", node.level


def _noun(path: Path) -> str:
    relative = path.relative_to(ROOT / "semloc_logs")
    return relative.parts[0].removesuffix(".py")


def _place(parts: Sequence[str]) -> tuple[int, int]:
    """Where a module stands, by the parts of its name below the package: in the order of rooms, and
    within its room.
    """
    room, *rest = parts
    inner = INNER_ORDER.get(room, [])
    return ORDER.index(room), inner.index(rest[0]) if rest and rest[0] in inner else len(inner)


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_module_imports_only_what_stands_before_it(path: Path) -> None:
    here = path.relative_to(ROOT / "semloc_logs").with_suffix("").parts
    if here == ("__init__",):
        assert all(
            m in ("semloc_logs.api", "semloc_logs.errors", "semloc_logs.settings")
            for m, _ in _imports(path)
            if m.startswith("semloc_logs")
        )
        return
    for module, level in _imports(path):
        assert level == 0, f"{path} imports relatively"
        package, *parts = module.split(".")
        if package == "semloc_logs" and parts:
            assert parts[0] in ORDER, f"{path} imports {module}, which has no place in the order"
            assert _place(parts) <= _place(here), f"{path} imports {module}, which stands behind it"


@pytest.mark.parametrize("room", sorted(INNER_ORDER))
def test_the_order_within_a_room_names_what_is_there(room: str) -> None:
    there = {p.stem if p.suffix else p.name for p in (ROOT / "semloc_logs" / room).iterdir()}
    assert set(INNER_ORDER[room]) <= there


def test_modules_do_not_import_each_other_in_circles() -> None:
    names = {
        ".".join(("semloc_logs", *p.relative_to(ROOT / "semloc_logs").with_suffix("").parts)): p
        for p in SOURCES
    }
    graph = {name: {m for m, _ in _imports(path) if m in names} for name, path in names.items()}
    assert tuple(TopologicalSorter(graph).static_order())


def test_every_module_has_a_place() -> None:
    assert {_noun(p) for p in SOURCES} - {"__init__"} <= set(ORDER)


@pytest.mark.parametrize(
    "path",
    [*SOURCES, *CLI, *sorted((ROOT / "tests").rglob("*.py"))],
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_nobody_imports_the_checkouts_cli(path: Path) -> None:
    assert not [
        m for m, level in _imports(path) if level == 0 and m.split(".")[0] in ("cli", "schemas")
    ]


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_only_the_cli_prints_or_exits(path: Path) -> None:
    calls = [
        node.func
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
    ]
    assert not [
        c
        for c in calls
        if isinstance(c, ast.Name) and c.id in ("print", "input", "exit", "quit", "breakpoint")
    ]
    assert not [
        c
        for c in calls
        if isinstance(c, ast.Attribute)
        and c.attr == "exit"
        and isinstance(c.value, ast.Name)
        and c.value.id == "sys"
    ]


@pytest.mark.parametrize("path", CLI, ids=lambda p: str(p.relative_to(ROOT / "cli")))
def test_cli_imports_its_siblings_relatively_and_nothing_heavy(path: Path) -> None:
    light = {"semloc_logs", "semloc_logs.errors"}
    at_import = [
        n
        for n in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(n, ast.Import | ast.ImportFrom)
    ]
    for node in at_import:
        names = (
            [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
        )
        if isinstance(node, ast.ImportFrom) and node.level:
            continue
        for name in names:
            assert name in light or not name.startswith("semloc_logs"), (
                f"{path.name} imports {name} before it is needed"
            )
            assert name.split(".")[0] not in {
                "torch",
                "numba",
                "pyarrow",
                "scipy",
                "cv2",
                "pydantic",
                "numpy",
                "rich",
            }


def test_what_commands_share_imports_no_command() -> None:
    """The program imports commands by name, when they are called."""
    shared = [path for path in CLI if path.parent == ROOT / "cli"]
    assert not [
        (path.name, module)
        for path in shared
        for module, level in _imports(path)
        if level == 1 and module.split(".")[0] == "commands"
    ]


def test_every_command_has_a_module() -> None:
    folder = ROOT / "cli" / "commands"
    commands = {
        ".".join(path.relative_to(folder).with_suffix("").parts)
        for path in folder.rglob("*.py")
        if "\ncommand = " in (text := path.read_text()) or "\ndef command(" in text
    }
    assert commands == {module for module, _ in COMMANDS.values()}


@pytest.mark.parametrize("package", ["matplotlib", "torch"])
def test_stages_load_what_is_slow_to_load_only_where_they_draw_or_describe(package: str) -> None:
    script = f"import sys, semloc_logs.stages.run; sys.exit({package!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0

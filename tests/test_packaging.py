"""The wheel holds what the checkout holds, and one top-level name."""

import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAPPED = {"semloc_logs.cli": "cli", "semloc_logs.schemas": "schemas"}


def _folders() -> set[str]:
    """Packages as the folders say."""
    tops = {"semloc_logs": "semloc_logs", **MAPPED}
    return {
        ".".join((package, *p.parent.relative_to(ROOT / folder).parts))
        for package, folder in tops.items()
        for p in (ROOT / folder).rglob("__init__.py")
    }


def test_packages_listed_are_the_folders() -> None:
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert set(tool["packages"]) == _folders()
    assert {k: v for k, v in tool["package-dir"].items() if k in MAPPED} == MAPPED


def test_every_folder_with_modules_is_a_package() -> None:
    folders = {
        p.parent for top in ("semloc_logs", "cli", "schemas") for p in (ROOT / top).rglob("*.py")
    }
    assert not [f for f in folders if not (f / "__init__.py").exists()]


def test_no_module_of_the_cli_is_named_like_one_of_the_standard_library() -> None:
    assert not {p.stem for p in (ROOT / "cli").rglob("*.py")} & sys.stdlib_module_names


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Built from a copy, so that no build/ folder of the checkout takes part."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    for name in ("semloc_logs", "cli", "schemas"):
        shutil.copytree(
            ROOT / name,
            source / name,
            ignore=shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc"),
        )
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "-w",
        str(folder),
        ".",
    ]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, timeout=55)
    assert done.returncode == 0, done.stderr
    return zipfile.ZipFile(next(folder.glob("*.whl")))


def test_wheel_has_one_top_level_name(wheel: zipfile.ZipFile) -> None:
    top = next(n for n in wheel.namelist() if n.endswith(".dist-info/top_level.txt"))
    assert wheel.read(top).decode().split() == ["semloc_logs"]
    assert {n.split("/")[0] for n in wheel.namelist() if ".dist-info/" not in n} == {"semloc_logs"}


def test_wheel_has_every_module_and_data_file(wheel: zipfile.ZipFile) -> None:
    wanted = set()
    for name in ("semloc_logs", "cli", "schemas"):
        inside = "semloc_logs" if name == "semloc_logs" else f"semloc_logs/{name}"
        for path in (ROOT / name).rglob("*"):
            kept = path.is_file() and path.suffix in {
                ".py",
                ".json",
                ".yaml",
                ".msg",
                ".proto",
                ".safetensors",
                ".typed",
            }
            if kept and "__pycache__" not in path.parts:
                wanted.add(f"{inside}/{path.relative_to(ROOT / name).as_posix()}")
    assert not wanted - set(wheel.namelist())


def test_wheel_has_the_console_script_and_the_licence(wheel: zipfile.ZipFile) -> None:
    script = next(n for n in wheel.namelist() if n.endswith("entry_points.txt"))
    assert "semloc = semloc_logs.cli.main:main" in wheel.read(script).decode()
    assert any(n.endswith("LICENSE") for n in wheel.namelist())


def test_schemas_are_readable_from_the_wheel(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    wheel.extractall(tmp_path)
    program = (
        "import semloc_logs.schemas as s; print(s.__file__,"
        " len(s.read_text('parquet/closures.json')), *s.names('parquet', '.json'))"
    )
    command = [sys.executable, "-P", "-c", program]
    done = subprocess.run(
        command, cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    where, size, *names = done.stdout.split()
    assert Path(where) == tmp_path / "semloc_logs/schemas/__init__.py"
    assert int(size) > 500
    assert "closures" in names

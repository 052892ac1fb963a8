"""Contracts as files: Parquet columns, message definitions, label spaces."""

from importlib.resources import files


def read_text(name: str) -> str:
    """The file ``name`` (a path below this folder) as shipped."""
    return files(__name__).joinpath(name).read_text(encoding="utf-8")


def names(folder: str, suffix: str) -> list[str]:
    """Stems of the files in ``folder`` that end in ``suffix``, sorted."""
    return sorted(
        f.name.removesuffix(suffix)
        for f in files(__name__).joinpath(folder).iterdir()
        if f.name.endswith(suffix)
    )

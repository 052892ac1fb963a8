"""semloc import."""

from __future__ import annotations

from pathlib import Path

import click

from ..console import console
from ..options import Command, console_options, json_option, overwrite_option, path_option


@click.command(cls=Command)
@click.argument("name", metavar="DATASET")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@path_option("-o", "--output", help="Folder of the logs and of truth.json.  [default: DATASET]")
@overwrite_option
@json_option
@console_options
def command(name: str, folder: Path, output: Path | None, overwrite: bool, as_json: bool) -> int:
    """Sequences of a public data set as MCAP logs, with their true poses for 'semloc evaluate' and
    'semloc benchmark paper'. DATASET is kitti (odometry), semantickitti, nclt or boreas; DIR is the
    folder that it was unpacked to.

    \b
    Example:  semloc import kitti dataset -o kitti
    """
    from semloc_logs.experiments.datasets.conversion import import_dataset

    with console.progress():
        truth, logs = import_dataset(name, folder, output or Path(name), overwrite=overwrite)
    if as_json:
        console.result_json({"truth": str(truth), "logs": [str(log) for log in logs]})
    else:
        for path in (*logs, truth):
            console.result(str(path))
    return 0

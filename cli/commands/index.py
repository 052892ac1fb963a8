"""semloc index."""

from __future__ import annotations

from pathlib import Path

import click

from ..console import console
from ..options import Command, console_options, json_option, work_option


@click.command(cls=Command)
@work_option
@json_option
@console_options
def command(work: Path, as_json: bool) -> int:
    """Bring the index of the words of all sessions up to date and say what it holds. 'semloc close'
    does so itself: the index tells it which sessions a query may meet.

    Files are read in full and damaged ones are built again.

    \b
    Example:  semloc index -w work
    """
    from semloc_logs.words.segment_catalogue import update
    from semloc_logs.workspace import Workspace

    held = update(Workspace(work))
    if as_json:
        console.result_json({"work": str(work), "variants": held})
        return 0
    for variant, content in held.items():
        rows = [
            (s["file"], f"{s['words']}", f"{s['bytes'] / 1e6:.1f}", ", ".join(s["sessions"]))
            for s in content["segments"]
        ]
        console.table(f"{variant} words", ("segment", "words#", "MB#", "sessions"), rows)
        if content["changed"]:
            console.note(f"{variant} words: {content['changed']}")
    return 0

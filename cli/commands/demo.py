"""semloc demo."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..console import console
from ..inputs import Entry, session_inputs
from ..options import Command, EngineChoice, stage_options
from ..results import finish, report_json
from .evaluate import show_evaluation

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved

QUERY_EVERY = 20.0  # m; a demonstration need not ask every two metres


@click.command(cls=Command)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=Path("demo"),
    show_default=True,
    help="Folder of the logs and the workspace.",
)
@stage_options
def command(
    output: Path, overwrite: bool, as_json: bool, engine: EngineChoice, settings: Resolved
) -> int:
    """Everything once: two drives round a simulated block on two days, their maps, closures, the
    truth, and an annotated log to look at.

    \b
    Example:  semloc demo -o /tmp/demo
    """
    from semloc_logs.evaluation.truth import evaluate_closures
    from semloc_logs.simulation.demo import simulate_demo
    from semloc_logs.simulation.meshes.world import require_ray_caster
    from semloc_logs.stages.annotate import AnnotationMode
    from semloc_logs.stages.inputs import Redo
    from semloc_logs.stages.run import run
    from semloc_logs.stages.state import settle
    from semloc_logs.workspace import Workspace

    logs = [output / "monday.mcap", output / "tuesday.bag"]
    truth = output / "truth.json"
    workspace = Workspace(output / "work")
    query = settings.query.model_copy(update={"every": QUERY_EVERY})
    given = settings.model_copy(update={"query": query})
    settings = settle(workspace, given, writes=True, overwrite=overwrite).resolved()
    with console.progress():
        if overwrite or not truth.exists():
            require_ray_caster("semloc demo")
            console.note(f"Simulating two drives in {output}")
            simulate_demo(output)
        with engine.open(len(logs)) as opened:
            report = run(
                session_inputs(Entry(None, (log,)) for log in logs),
                workspace,
                settings,
                opened,
                annotation=AnnotationMode.COPY,
                redo=Redo.of(overwrite=overwrite),
            )
    result = evaluate_closures(workspace, truth, settings)
    if as_json:
        console.result_json(report_json(report, workspace.path) | {"evaluation": result.to_json()})
        return finish(report)
    show_evaluation(result)
    console.result(f"Closures:      {workspace.closures}")
    for path in sorted(workspace.annotated.glob("*.mcap")):
        console.result(f"Annotated log: {path}")
    if workspace.picture.exists():
        console.result(f"Picture:       {workspace.picture}")
    console.result(
        ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in report.seconds.items())
    )
    return finish(report)

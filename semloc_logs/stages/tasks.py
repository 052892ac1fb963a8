"""The tasks of a stage, for clusters that run programs: each is one unit of the stage's work.

Tasks of one stage can be done at once, in any order and any number of times, on machines that see
the same workspace. The tables are the same as after ``semloc run``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from semloc_logs.closures.exclusions import Exclusions
from semloc_logs.closures.session_pairs import Pair, known_pairs, pairs_of_sessions
from semloc_logs.engines import Engine
from semloc_logs.errors import SettingsError, WorkspaceError, did_you_mean
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved
from semloc_logs.stages.close import close, is_decided
from semloc_logs.stages.describe import describe, plan_describe
from semloc_logs.stages.fuse import fuse, plan_fuse
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.lock import searching
from semloc_logs.stages.pair_search import PairSearch, pair_fingerprints
from semloc_logs.stages.report import Report
from semloc_logs.stages.state import keep
from semloc_logs.workspace import Workspace


class Stage(StrEnum):
    """The stages whose work is cut into tasks, in their order."""

    FUSE = "fuse"
    DESCRIBE = "describe"
    SEARCH = "search"
    DECIDE = "decide"


@dataclass(frozen=True, slots=True)
class StageTask:
    """One unit of work; its id is as ``fuse/monday``, ``search/tuesday/monday`` or ``decide``.

    ``names`` are the sessions, ``inputs`` the logs or the folders of the workspace that are read.
    """

    stage: Stage
    names: tuple[str, ...]
    inputs: tuple[str, ...]
    done: bool

    @property
    def id(self) -> str:
        return "/".join((self.stage, *self.names))


def list_tasks(
    stage: Stage, sessions: Sequence[SessionInput], work: Workspace, settings: Resolved
) -> list[StageTask]:
    """All tasks of a stage, also the done ones, in the order of their ids.

    ``sessions`` are needed to fuse. Raises WorkspaceError where the stage lacks its input.
    """
    names = _task_names(stage, sessions, work, settings)
    folder = work.path / "sessions"
    match stage:
        case Stage.FUSE:
            kept = plan_fuse(sessions, work, settings, redo=Redo.FAILED).report.kept
            logs = {session.name: tuple(map(str, session.logs)) for session in sessions}
            return [StageTask(stage, n, logs[n[0]], n[0] in kept) for n in names]
        case Stage.DESCRIBE:
            missing = plan_describe(work, work.chosen(()), settings)
            return [StageTask(stage, n, (str(folder / n[0]),), n[0] not in missing) for n in names]
        case Stage.SEARCH:
            maps = _maps(work)
            known = known_pairs(work)
            fingerprints = pair_fingerprints(maps, settings)
            done = [known.get(Pair(*n)) == fingerprints[Pair(*n)] for n in names]
            inputs = [tuple(str(folder / name) for name in n) for n in names]
            return [StageTask(stage, *task) for task in zip(names, inputs, done, strict=True)]
        case Stage.DECIDE:
            is_done = is_decided(work, settings)
            return [StageTask(stage, (), (str(work.all_alignments),), is_done)]


def task_ids(
    stage: Stage, sessions: Sequence[SessionInput], work: Workspace, settings: Resolved
) -> list[str]:
    """The ids alone: quick, since thousands of jobs of an array may need them."""
    return ["/".join((stage, *n)) for n in _task_names(stage, sessions, work, settings)]


def _task_names(
    stage: Stage, sessions: Sequence[SessionInput], work: Workspace, settings: Resolved
) -> list[tuple[str, ...]]:
    match stage:
        case Stage.FUSE:
            return sorted((session.name,) for session in sessions)
        case Stage.DESCRIBE:
            return sorted((folder.name,) for folder in work.chosen(()))
        case Stage.SEARCH:
            maps = _maps(work)
            exclusions = Exclusions.of(maps, settings)
            return [(p.query, p.target) for p in pairs_of_sessions(maps) if not exclusions.has(p)]
        case Stage.DECIDE:
            return [()]


def _maps(work: Workspace) -> dict[str, SessionMap]:
    return {folder.name: SessionMap(folder) for folder in work.chosen(())}


def parse_task(text: str) -> tuple[Stage, tuple[str, ...]]:
    """The stage of a task and its sessions. SettingsError where it is not an id."""
    name, *names = text.split("/")
    if name not in list(Stage):
        raise SettingsError(
            f"'{text}' is not a task: 'semloc tasks STAGE' lists them; the stages are"
            f" {', '.join(Stage)}.{did_you_mean(name, list(Stage))}"
        )
    stage = Stage(name)
    wanted = {Stage.SEARCH: "search/QUERY/TARGET", Stage.DECIDE: "decide"}
    if len(names) != {Stage.SEARCH: 2, Stage.DECIDE: 0}.get(stage, 1) or "" in names:
        form = wanted.get(stage, f"{name}/SESSION")
        raise SettingsError(f"'{text}' is not a task: write {form}.")
    return stage, tuple(names)


def do_task(
    text: str,
    sessions: Sequence[SessionInput],
    work: Workspace,
    settings: Resolved,
    engine: Engine,
    *,
    redo: Redo = Redo.NOTHING,
) -> Report:
    """Do the task with this id, unless it is done; the sessions are needed to fuse.

    Raises SettingsError for an unknown task, WorkspaceError where its input is missing, and
    TemporaryError where it may succeed later.
    """
    stage, names = parse_task(text)
    match stage:
        case Stage.FUSE:
            known = [session.name for session in sessions]
            if names[0] not in known:
                raise SettingsError(
                    f"None of the logs is session '{names[0]}': give the logs of all sessions, as"
                    f" for 'semloc tasks fuse'.{did_you_mean(names[0], known)}"
                )
            return fuse(sessions, work, settings, engine, names=names, redo=redo)
        case Stage.DESCRIBE:
            return describe(work, names, settings, engine)
        case Stage.SEARCH:
            return _search(Pair(*names), work, settings, engine)
        case Stage.DECIDE:
            return _decide(work, settings, engine)


def _search(pair: Pair, work: Workspace, settings: Resolved, engine: Engine) -> Report:
    work.chosen(sorted({pair.query, pair.target}))
    with searching(work, pair.query, pair.target):
        search = PairSearch.of_pair(work, settings, pair)
        keep(work, settings)
        search.run(engine)
    report = Report(skipped=search.exclusions.sentences())
    (report.done if search.chosen else report.kept).append(f"search/{pair.query}/{pair.target}")
    return report


def _decide(work: Workspace, settings: Resolved, engine: Engine) -> Report:
    missing = [task.id for task in list_tasks(Stage.SEARCH, [], work, settings) if not task.done]
    if missing:
        raise WorkspaceError(
            f"{len(missing)} pairs of {work.path} are not searched yet ({missing[0]} and others):"
            f" do their tasks first, or run 'semloc close -w {work.path}'."
        )
    return close(work, settings, engine)

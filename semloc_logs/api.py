"""The public API: the same stages, words and files as the command line, for notebooks and scripts.

    import semloc_logs as semloc

    work = semloc.Workspace("work")
    work.run(["monday.mcap", "tuesday.bag"])
    for closure in work.closures():
        print(closure.query_session, closure.target_session, closure.probability)

Nothing is printed: long calls report to ``progress``, notices go to the logger ``semloc_logs``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
import pyarrow as pa

from semloc_logs.arrays import F64
from semloc_logs.engines import Engine, make_engine
from semloc_logs.errors import SettingsError, WorkspaceError
from semloc_logs.evaluation.truth import Evaluation, evaluate_closures
from semloc_logs.exports.map_points import SessionPoints
from semloc_logs.logs.annotation.annotate import AnnotateReport
from semloc_logs.logs.containers import open as containers
from semloc_logs.logs.log import Log
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.logs.remote import log_path
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import transform
from semloc_logs.progress import Listener, listening
from semloc_logs.settings import Resolved, Settings, load
from semloc_logs.stages.annotate import Annotation, AnnotationMode, annotate
from semloc_logs.stages.close import close
from semloc_logs.stages.describe import describe
from semloc_logs.stages.fuse import fuse
from semloc_logs.stages.inputs import Redo, SessionInput, session_name
from semloc_logs.stages.pair_search import Selection
from semloc_logs.stages.report import Report
from semloc_logs.stages.run import run
from semloc_logs.stages.state import settle
from semloc_logs.tables.table import read_table
from semloc_logs.workspace import SessionFolder
from semloc_logs.workspace import Workspace as Folder

PathLike = str | Path
Logs = Sequence[PathLike] | Mapping[str, PathLike | Sequence[PathLike]]
EngineName = Literal["serial", "processes", "dask"]


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """A loop closure: one row of closures.parquet.

    ``target_T_query`` (4, 4) is the pose of the query's base frame at ``query_stamp_ns`` in the
    target's base frame at ``target_stamp_ns``, metres. ``covariance`` (6, 6) is in the target's
    axes, in the order x y z rotation-x rotation-y rotation-z (m, rad).
    """

    query_session: str
    target_session: str
    query_stamp_ns: int
    target_stamp_ns: int
    target_T_query: F64
    covariance: F64
    overlap: float
    probability: float
    inliers: int
    words: int


class Closures(Sequence[Closure]):
    """The rows of closures.parquet, sorted by query session and time."""

    def __init__(self, table: pa.Table) -> None:
        self._table = table

    def __len__(self) -> int:
        return int(self._table.num_rows)

    @overload
    def __getitem__(self, index: int) -> Closure: ...

    @overload
    def __getitem__(self, index: slice) -> list[Closure]: ...

    def __getitem__(self, index: int | slice) -> Closure | list[Closure]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        row = self._table.slice(range(len(self))[index], 1).to_pylist()[0]
        translation = np.array([row[f"t_{axis}"] for axis in "xyz"])
        quaternion = np.array([row[f"q_{axis}"] for axis in "xyzw"])
        return Closure(
            row["query_session"],
            row["target_session"],
            row["query_stamp_ns"],
            row["target_stamp_ns"],
            transform(translation, quaternion),
            np.array(row["covariance"]).reshape(6, 6),
            row["overlap"],
            row["probability"],
            row["inliers"],
            row["words"],
        )

    def to_arrow(self) -> pa.Table:
        """The table as it is in the file."""
        return self._table

    def to_pandas(self) -> Any:
        """The table as a pandas DataFrame. SettingsError where pandas is not installed."""
        try:
            return self._table.to_pandas()
        except ModuleNotFoundError as error:
            raise SettingsError(
                "pandas is not installed: run 'pip install pandas', or use to_arrow()."
            ) from error

    def __repr__(self) -> str:
        return f"Closures({len(self)})"


@dataclass(frozen=True, slots=True)
class Session:
    """A fused session of a workspace."""

    folder: SessionFolder

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def info(self) -> dict[str, Any]:
        """The content of session.json: logs, topics, frames, label source, settings, versions."""
        return SessionMap(self.folder).json

    def trajectory(self) -> pa.Table:
        """Poses of the base frame in the session frame: ``stamp_ns``, ``t_x`` .. ``q_w``."""
        return read_table(self.folder.trajectory)

    @property
    def keyframes(self) -> pa.Table:
        """One row a keyframe: ``stamp_ns``, ``topic``, pose in the map frame, and more."""
        return read_table(self.folder.frames)

    def voxels(self, frame: Literal["session", "map"] = "session") -> pa.Table:
        """Centres of the occupied voxels: ``x y z`` (m) in the frame of the log's poses or in the
        level map frame, and ``label``, a Cityscapes train id (255 = unlabelled).
        """
        return self._points("voxels", frame)

    def points(self, frame: Literal["session", "map"] = "session") -> pa.Table:
        """The points of the keyframes: columns as of :meth:`voxels`."""
        return self._points("keyframes", frame)

    def _points(self, what: str, frame: str) -> pa.Table:
        if frame not in ("session", "map"):
            raise SettingsError(f"frame is 'session' or 'map', not {frame!r}.")
        batches = list(SessionPoints(SessionMap(self.folder), what, frame, None).batches())
        points = np.concatenate([np.zeros((0, 3)), *(xyz for xyz, _ in batches)])
        labels = np.concatenate([np.zeros(0, np.uint8), *(label for _, label in batches)])
        columns = {axis: points[:, k] for k, axis in enumerate("xyz")}
        return pa.table({**columns, "label": labels})


class Workspace:
    """A folder of sessions and of the closures between them; made when something is written to it.

    ``settings`` is a :class:`Settings`, a YAML file, or a mapping of key paths such as
    ``{"fusion.voxel_size": 0.05}``. ``engine`` is ``"serial"``, ``"processes"``, ``"dask"`` or an
    engine (:func:`semloc_logs.engines.make_engine`), with ``jobs`` workers (default: the cores this
    process may use). Scripts that use processes keep their calls under ``if __name__ ==
    "__main__":``, since workers import them again. ``progress`` is called with a
    :class:`semloc_logs.progress.Progress` now and then.

    Every stage skips work that is up to date, unless ``overwrite``. Errors are of the type
    :class:`semloc_logs.errors.SemlocError`, one sentence each.
    """

    def __init__(
        self,
        path: PathLike,
        *,
        settings: Settings | PathLike | Mapping[str, object] | None = None,
        engine: EngineName | Engine = "serial",
        jobs: int | None = None,
        progress: Listener | None = None,
    ) -> None:
        self._folder = Folder(Path(path))
        self._given = _settings(settings)
        self._engine = engine
        self._jobs = jobs
        self._progress = progress

    def __repr__(self) -> str:
        return f"Workspace({str(self.path)!r})"

    @property
    def path(self) -> Path:
        return self._folder.path

    @property
    def settings(self) -> Resolved:
        """Those that the workspace keeps, and those that were given; SettingsError where these
        contradict.
        """
        return self._settled(writes=True)

    def _settled(self, *, writes: bool, overwrite: bool = False) -> Resolved:
        return settle(self._folder, self._given, writes=writes, overwrite=overwrite).resolved()

    # -- the stages

    def run(
        self,
        logs: Logs,
        *,
        topics: Mapping[str, str] | None = None,
        poses: Mapping[str, PathLike] | None = None,
        annotate: Literal["none", "copy", "in-place", "sidecar"] = "none",
        overwrite: bool = False,
    ) -> Report:
        """Logs -> closures, all of it. Each log is a session; a mapping names the sessions, and
        several logs of one name are one session. ``poses``: trajectory files by session.
        """
        inputs = _inputs(logs, topics, poses)
        mode = AnnotationMode(annotate)
        with self._open_engine() as engine:
            return run(
                inputs,
                self._folder,
                self._settled(writes=True, overwrite=overwrite),
                engine,
                annotation=mode,
                redo=Redo.of(overwrite=overwrite),
            )

    def fuse(
        self,
        logs: Logs,
        *,
        topics: Mapping[str, str] | None = None,
        poses: Mapping[str, PathLike] | None = None,
        overwrite: bool = False,
    ) -> Report:
        """Logs -> the semantic map of each session; arguments as of :meth:`run`."""
        inputs = _inputs(logs, topics, poses)
        settings = self._settled(writes=True, overwrite=overwrite)
        with self._open_engine() as engine:
            return fuse(inputs, self._folder, settings, engine, redo=Redo.of(overwrite=overwrite))

    def describe(self, *sessions: str, overwrite: bool = False) -> Report:
        """Maps -> semantic words of ``sessions``, by default of all."""
        settings = self._settled(writes=True, overwrite=overwrite)
        with self._open_engine() as engine:
            return describe(self._folder, sessions, settings, engine, overwrite=overwrite)

    def close(
        self,
        *,
        queries: Sequence[str] = (),
        targets: Sequence[str] = (),
        self_closures: bool = True,
        overwrite: bool = False,
    ) -> Report:
        """Words -> closures of ``queries`` in ``targets``, by default of all sessions in all."""
        selection = Selection(tuple(queries), tuple(targets), self_closures)
        settings = self._settled(writes=True, overwrite=overwrite)
        with self._open_engine() as engine:
            return close(self._folder, settings, engine, selection, overwrite=overwrite)

    def annotate(
        self,
        log: PathLike,
        output: PathLike | None = None,
        *,
        mode: Literal["copy", "in-place", "sidecar"] = "copy",
        session: str | None = None,
        overwrite: bool = False,
    ) -> AnnotateReport:
        """Closures -> channels of ``log``: in the file ``output``, or in the log itself."""
        target = None if output is None else log_path(output)
        annotation = Annotation(AnnotationMode(mode), target, overwrite)
        settings = self._settled(writes=False)
        return annotate(log_path(log), self._folder, settings, annotation, session=session)

    # -- contents

    @property
    def sessions(self) -> list[str]:
        """Names of the fused sessions."""
        return [folder.name for folder in self._folder.sessions()]

    def __getitem__(self, name: str) -> Session:
        """A session by name. Raises WorkspaceError where it is missing."""
        return Session(self._folder.chosen([name])[0])

    def __contains__(self, name: object) -> bool:
        return name in self.sessions

    def __iter__(self) -> Iterator[Session]:
        return (Session(folder) for folder in self._folder.sessions())

    def closures(self) -> Closures:
        """The accepted closures. Raises WorkspaceError where close has not run yet."""
        return Closures(self._table(self._folder.closures))

    def rejected(self) -> pa.Table:
        """The best rejected hypotheses of every query, with the reason."""
        return self._table(self._folder.rejected)

    def evaluate(self, truth: PathLike) -> Evaluation:
        """The closures against a truth file."""
        return evaluate_closures(self._folder, Path(truth), self._settled(writes=False))

    def _table(self, path: Path) -> pa.Table:
        if not path.exists():
            raise WorkspaceError(f"{path} is missing: run close first.")
        return read_table(path)

    @contextmanager
    def _open_engine(self) -> Iterator[Engine]:
        is_own = isinstance(self._engine, str)
        engine = (
            make_engine(self._engine, self._jobs) if isinstance(self._engine, str) else self._engine
        )
        with nullcontext() if self._progress is None else listening(self._progress):
            try:
                yield engine
            except BaseException:
                if is_own:
                    engine.stop()
                raise
            if is_own:
                engine.close()


def open_log(path: PathLike) -> AbstractContextManager[Log]:
    """A log, to read in a ``with`` block: MCAP, ROS 1 or ROS 2 bag, .db3 file, map of points.

    ``log.frames()`` gives typed frames (:mod:`semloc_logs.frames`) in log-time order,
    ``log.streams`` the topics. Raises LogError for other files.
    """
    return closing(containers.open_log(path))


def evaluate(work: Workspace, truth: PathLike) -> Evaluation:
    """The closures of a workspace against a truth file."""
    return work.evaluate(truth)


def _settings(settings: Settings | PathLike | Mapping[str, object] | None) -> Settings:
    if settings is None:
        return Settings()
    if isinstance(settings, Settings):
        return settings
    if isinstance(settings, Mapping):
        return load(assignments={key: str(value) for key, value in settings.items()})
    return load(Path(settings))


def _inputs(
    logs: Logs, topics: Mapping[str, str] | None, poses: Mapping[str, PathLike] | None
) -> list[SessionInput]:
    if isinstance(logs, str | Path):
        raise TypeError(f"logs is a list of paths or a mapping of names to paths, not {logs!r}")
    named: Iterable[tuple[str, PathLike | Sequence[PathLike]]]
    if isinstance(logs, Mapping):
        named = logs.items()
    else:
        named = [(session_name(log_path(log)), log) for log in logs]
    files = {name: TrajectoryFile(Path(path)) for name, path in (poses or {}).items()}
    inputs: dict[str, SessionInput] = {}
    for name, paths in named:
        if name in inputs:
            raise ValueError(f"two logs would both be session {name!r}: name them in a mapping")
        several = [paths] if isinstance(paths, str | Path) else paths
        logs_of_session = tuple(log_path(path) for path in several)
        inputs[name] = SessionInput(name, logs_of_session, topics or {}, files.get(name))
    return list(inputs.values())

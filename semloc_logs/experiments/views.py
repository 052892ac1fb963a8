"""The views of fused sessions whose true poses are known: a sequence that is read view by view."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64
from semloc_logs.errors import WorkspaceError
from semloc_logs.evaluation.headings import headings_deg
from semloc_logs.evaluation.truth import read_truth
from semloc_logs.experiments.system import View
from semloc_logs.experiments.view_pictures import PictureFolder
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.voxels.store import read_keyframe
from semloc_logs.workspace import Workspace

_HIDDEN = np.full((4, 4), np.nan)  # the true pose of a query, as systems get it


@dataclass(eq=False)
class SessionViews:
    """The keyframes of a ``session`` and their true poses ``world_T_base`` (n, 4, 4), which are
    ``known`` (n,); ``pictures`` where a camera recorded some.
    """

    session: SessionMap
    world_T_base: F64
    known: NDArray[np.bool_]
    pictures: PictureFolder | None = None

    def __len__(self) -> int:
        return len(self.world_T_base)

    @cached_property
    def _origins(self) -> NDArray[np.float32]:
        return self.session.origins.astype(np.float32)

    def view(self, number: int) -> View:
        """A view, read from the tables."""
        keyframe = read_keyframe(self.session.folder.keyframes, number)
        view = View(
            session=self.session.folder.name,
            stamp_ns=int(self.session.stamps_ns[number]),
            points=keyframe.points,
            label=keyframe.label,
            origin=self._origins[number],
            odom_T_base=self.session.map_T_base[number],
            world_T_base=self.world_T_base[number],
        )
        if self.pictures is None:
            return view
        return replace(view, picture=self.pictures.picture(number, keyframe.points))


@dataclass(eq=False)
class ViewStore(Sequence[View]):
    """All views of some sessions, one after the other; only poses and stamps stay in memory."""

    sessions: list[SessionViews]

    @cached_property
    def _first(self) -> I64:
        """Number of the first view (sessions + 1,) of each session."""
        return np.cumsum([0, *(len(s) for s in self.sessions)])

    @cached_property
    def session_of(self) -> I64:
        """Number of the session (n,) of each view."""
        return np.repeat(np.arange(len(self.sessions)), np.diff(self._first))

    @cached_property
    def names(self) -> list[str]:
        """The name of each session."""
        return [s.session.folder.name for s in self.sessions]

    @cached_property
    def world_T_base(self) -> F64:
        """True poses (n, 4, 4)."""
        return np.concatenate([s.world_T_base for s in self.sessions])

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Which views (n,) have a true pose."""
        return np.concatenate([s.known for s in self.sessions])

    @cached_property
    def stamps_ns(self) -> I64:
        """Sensor times (n,)."""
        return np.concatenate([s.session.stamps_ns for s in self.sessions])

    @cached_property
    def headings_deg(self) -> F64:
        """Direction (n,) of the x axis of the base in the plane, degrees in [0, 360)."""
        return headings_deg(self.world_T_base)

    @property
    def has_pictures(self) -> bool:
        """Whether every session has pictures."""
        return all(s.pictures is not None for s in self.sessions)

    def without_pictures(self) -> ViewStore:
        """The same views without their pictures, which take most of the time of reading them."""
        sessions = [copy(session) for session in self.sessions]
        for session in sessions:
            session.pictures = None
        return ViewStore(sessions)

    def __len__(self) -> int:
        return int(self._first[-1])

    @overload
    def __getitem__(self, index: int) -> View: ...

    @overload
    def __getitem__(self, index: slice) -> ViewSelection: ...

    def __getitem__(self, index: int | slice) -> View | ViewSelection:
        if isinstance(index, slice):
            return ViewSelection(self, np.arange(len(self))[index])
        number = range(len(self))[index]
        session = int(self.session_of[number])
        return self.sessions[session].view(number - int(self._first[session]))

    def of_session(self, name: str) -> I64:
        """Numbers of the views of a session whose true pose is known."""
        if name not in self.names:
            raise WorkspaceError(f"Session {name} is not there: there are {', '.join(self.names)}.")
        return np.flatnonzero((self.session_of == self.names.index(name)) & self.known)

    def selection(self, numbers: Iterable[int] | I64) -> ViewSelection:
        """The views of these numbers, read when they are taken."""
        return ViewSelection(self, np.asarray(numbers, np.int64))

    def hidden(self, number: int) -> View:
        """A view without its true pose, as a query."""
        return replace(self[number], world_T_base=_HIDDEN.copy())


@dataclass(frozen=True, eq=False)
class ViewSelection(Sequence[View]):
    """The views ``numbers`` (n,) of a store."""

    store: ViewStore
    numbers: I64

    def __len__(self) -> int:
        return len(self.numbers)

    @overload
    def __getitem__(self, index: int) -> View: ...

    @overload
    def __getitem__(self, index: slice) -> ViewSelection: ...

    def __getitem__(self, index: int | slice) -> View | ViewSelection:
        if isinstance(index, slice):
            return ViewSelection(self.store, self.numbers[index])
        return self.store[int(self.numbers[index])]


def read_views(
    work: Workspace,
    truth: Path,
    sessions: Sequence[str] = (),
    pictures: Path | None = None,
) -> ViewStore:
    """The views of fused ``sessions``, all of the workspace without names, that a truth file knows.

    ``pictures``: the folder of the sessions' pictures. TruthError for a truth file that is missing
    or knows none of them.
    """
    chosen = set(sessions)
    maps = {f.name: SessionMap(f) for f in work.sessions() if not chosen or f.name in chosen}
    tracks = read_truth(truth, maps)
    views = []
    for name, track in tracks.items():
        poses, known = track.at(maps[name].stamps_ns)
        folder = None if pictures is None else PictureFolder.opened(pictures / name)
        views.append(SessionViews(maps[name], poses, known, folder))
    return ViewStore(sorted(views, key=lambda s: s.session.folder.name))

"""Every path of a workspace, and nothing else (docs/reference/workspace.md)."""

from __future__ import annotations

import glob
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from semloc_logs.errors import WorkspaceError, did_you_mean

MOST_NAMED = 12  # sessions in a sentence


def checked_name(name: str) -> str:
    """``name``, if a folder can have it as a session's name; else WorkspaceError.

    It may come from the name of a log, from an option, or from a table: none may lead elsewhere.
    """
    unfit = any(c in "/\\" or unicodedata.category(c) in ("Cc", "Cs") for c in name)
    if not name or name.startswith(".") or unfit:
        raise WorkspaceError(
            f"A session cannot be called {name!r}, because a folder gets its name: rename the log, "
            "or name the session, without '.' at its start, separators and control characters."
        )
    return name


@dataclass(frozen=True, slots=True)
class SessionFolder:
    """WORK/sessions/SESSION; ``title`` is the session's name while it is written elsewhere."""

    path: Path
    title: str = ""

    @property
    def name(self) -> str:
        return self.title or self.path.name

    @property
    def session_json(self) -> Path:
        return self.path / "session.json"

    @property
    def trajectory(self) -> Path:
        return self.path / "trajectory.parquet"

    @property
    def fixes(self) -> Path:
        """Satellite fixes; workspaces of earlier versions have none."""
        return self.path / "fixes.parquet"

    @property
    def frames(self) -> Path:
        return self.path / "frames.parquet"

    @property
    def ground(self) -> Path:
        return self.path / "ground.parquet"

    @property
    def keyframes(self) -> Path:
        return self.path / "keyframes"

    @property
    def voxels(self) -> Path:
        return self.path / "voxels"

    @property
    def blocks(self) -> Path:
        return self.path / "blocks"

    @property
    def words(self) -> Path:
        return self.path / "words"

    @property
    def words_json(self) -> Path:
        return self.path / "words.json"

    @property
    def picture(self) -> Path:
        return self.path / "map.png"


@dataclass(frozen=True, slots=True)
class Workspace:
    """WORK."""

    path: Path

    def session(self, name: str) -> SessionFolder:
        """The folder of the session ``name``; WorkspaceError for a name that leads elsewhere."""
        return SessionFolder(self.path / "sessions" / checked_name(name))

    def sessions(self) -> list[SessionFolder]:
        """Sessions that were fused, by name."""
        files = sorted((self.path / "sessions").glob("*/session.json"))
        # what begins with a dot is being written
        return [SessionFolder(p.parent) for p in files if not p.parent.name.startswith(".")]

    def chosen(self, names: Sequence[str]) -> list[SessionFolder]:
        """The fused sessions ``names``, all without names. WorkspaceError where one is missing."""
        known = {folder.name: folder for folder in self.sessions()}
        if not known:
            raise WorkspaceError(f"{self.path} holds no sessions: run 'semloc fuse' first.")
        missing = [name for name in names if name not in known]
        if missing:
            listed = ", ".join(known) if len(known) <= MOST_NAMED else f"{len(known)} others"
            raise WorkspaceError(
                f"{self.path} has no session {', '.join(missing)} (it has {listed}): run 'semloc"
                f" fuse' first.{did_you_mean(missing[0], known)}"
            )
        return [known[name] for name in names] if names else list(known.values())

    @property
    def locks(self) -> Path:
        """Locks of the workspace and of sessions that are made, and who has them."""
        return self.path / ".locks"

    def session_lock(self, session: str) -> Path:
        return self.locks / f"session.{session}.lock"

    def pair_lock(self, query: str, target: str) -> Path:
        """Lock of the search of one session in another."""
        return self.locks / f"query={query}" / f"target={target}.lock"

    def pair_locks(self, query: str | None = None, target: str | None = None) -> list[Path]:
        """Those of the pairs with a query session or a target session."""
        ends = ["*" if name is None else glob.escape(name) for name in (query, target)]
        return sorted(self.locks.glob(f"query={ends[0]}/target={ends[1]}.lock"))

    @property
    def settings(self) -> Path:
        return self.path / "workspace.json"

    def failure(self, session: str) -> Path:
        """Why the log of a session could not be fused."""
        return self.path / "failed" / f"{session}.json"

    def failures(self) -> list[Path]:
        return sorted((self.path / "failed").glob("*.json"))

    @property
    def all_alignments(self) -> Path:
        """The folder of the alignments of all pairs of sessions."""
        return self.path / "alignments"

    def alignments(self, query: str, target: str) -> Path:
        """The alignments of one session's queries in another."""
        folder = self.alignments_of_query(query) / f"target={target}"
        return folder / "alignments.parquet"

    def alignments_of_query(self, query: str) -> Path:
        """The folder of the alignments of one session's queries."""
        return self.all_alignments / f"query={query}"

    def alignments_in_target(self, target: str) -> list[Path]:
        """The folders of the alignments in one session, with or without a table."""
        return sorted(self.all_alignments.glob(f"query=*/target={glob.escape(target)}"))

    def aligned_pairs(self) -> list[tuple[str, str]]:
        """Query and target sessions of the pairs whose alignments are there, by name."""
        files = self.all_alignments.glob("query=*/target=*/alignments.parquet")
        ends = ((path.parent.parent, path.parent) for path in files)
        return sorted(
            (query.name.partition("=")[2], target.name.partition("=")[2]) for query, target in ends
        )

    @property
    def all_search_parts(self) -> Path:
        """The folder of the searches that are not over, one for each query session."""
        return self.path / ".parts"

    def search_parts(self, query: str, target: str | None = None) -> Path:
        """Alignments of a session whose search is not over, a file for each task.

        With a ``target``, of a search in it alone.
        """
        folder = self.all_search_parts / query
        return folder if target is None else folder / f"target={target}"

    def segments(self, variant: str) -> Path:
        """The folder of the index of words of a variant of the descriptor."""
        return self.path / "index" / variant

    @property
    def closures(self) -> Path:
        return self.path / "closures.parquet"

    @property
    def rejected(self) -> Path:
        return self.path / "rejected.parquet"

    @property
    def optimized(self) -> Path:
        """Trajectories in common frames, and the graph that they come from."""
        return self.path / "optimized"

    def optimized_trajectory(self, session: str) -> Path:
        return self.optimized / f"{checked_name(session)}.parquet"

    @property
    def graph_closures(self) -> Path:
        """What became of every closure; sessions have any name, so it has a folder of its own."""
        return self.optimized / "graph" / "closures.parquet"

    @property
    def graph_vertices(self) -> Path:
        """Which keyframes the vertices of the graph are, and their poses."""
        return self.optimized / "graph" / "vertices.parquet"

    @property
    def graph_file(self) -> Path:
        """The graph as g2o text."""
        return self.optimized / "graph.g2o"

    def merged_map(self, frame: str) -> Path:
        """Voxels of all sessions in the map frame of the session ``frame``."""
        return self.optimized / "map" / checked_name(frame)

    def changed_voxels(self, frame: str) -> Path:
        """Voxels of that frame that sessions disagree about."""
        return self.optimized / "changes" / f"{checked_name(frame)}.parquet"

    @property
    def annotated(self) -> Path:
        return self.path / "annotated"

    @property
    def picture(self) -> Path:
        return self.path / "closures.png"

    @property
    def report(self) -> Path:
        return self.path / "report.html"

    @property
    def summary(self) -> Path:
        return self.path / "run.json"

"""Maps -> semantic words of each session."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path
from typing import Any

from semloc_logs import progress
from semloc_logs.engines import Engine
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved
from semloc_logs.stages.inputs import fingerprint_of, recorded_fingerprint
from semloc_logs.stages.lock import writing
from semloc_logs.stages.report import Report
from semloc_logs.stages.state import keep
from semloc_logs.subvolumes.submap_descriptors import DescribeTask, variants_for
from semloc_logs.tables.atomic_files import replacing_folder
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.voxels.store import blocks_path
from semloc_logs.words.submap_words import index_submap, write_words
from semloc_logs.workspace import SessionFolder, Workspace

LOGGER = logging.getLogger(__name__)
OTHER_WORDS = (
    "descriptor.weights is given without descriptor.vocabulary: the shipped words belong to the"
    " shipped weights and fit others badly; learn words of these with 'semloc vocabulary'."
)
KEPT_METADATA = (
    "schema_version",
    "voxel_size",
    "session_T_map",
    "label_space",
    "label_source",
    "version",
)


def describe(
    work: Workspace,
    names: Sequence[str],
    settings: Resolved,
    engine: Engine,
    *,
    overwrite: bool = False,
) -> Report:
    """Describe the sessions ``names`` (all if empty).

    Raises WorkspaceError where a session is missing or was fused with other settings.
    """
    folders = work.chosen(names)
    with writing(work, [folder.name for folder in folders]):
        return _describe(work, folders, settings, engine, overwrite)


def plan_describe(
    work: Workspace,
    folders: Sequence[SessionFolder],
    settings: Resolved,
    *,
    overwrite: bool = False,
) -> dict[str, tuple[str, ...]]:
    """The sessions to describe, with the networks that do it. Nothing is written."""
    # a session is comparable with all others, not only with those that are described now
    maps = {folder.name: SessionMap(folder) for folder in work.sessions()}
    sources = [session.label_source for session in maps.values()]
    plan = {}
    chosen = [maps[folder.name] for folder in folders]
    for session in chosen:
        check_settings(session, settings)
    for session in chosen:
        variants = variants_for(session.label_source, sources, settings)
        if overwrite or not is_described(session, variants, settings):
            plan[session.folder.name] = variants
    return plan


def _describe(
    work: Workspace,
    folders: Sequence[SessionFolder],
    settings: Resolved,
    engine: Engine,
    overwrite: bool,
) -> Report:
    plan = plan_describe(work, folders, settings, overwrite=overwrite)
    keep(work, settings)
    if plan and settings.descriptor.weights and not settings.descriptor.vocabulary:
        LOGGER.warning(OTHER_WORDS)
    report = Report(kept=[folder.name for folder in folders if folder.name not in plan])
    with ExitStack() as outputs:
        coming = [
            _Described(folder, plan[folder.name], settings, outputs)
            for folder in folders
            if folder.name in plan
        ]
        progress.report_start("describe", len(coming), "sessions")
        counts = engine.map(index_submap, chain.from_iterable(one.tasks() for one in coming))
        for number, one in enumerate(coming, 1):
            words = one.take(counts)
            report.amount += one.submaps
            report.done.append(one.folder.name)
            LOGGER.info("%s: %d words", one.folder.name, words)
            progress.report("describe", "", number, len(coming), "sessions")
    return report


def words_fingerprint(session: SessionMap, settings: Resolved) -> str:
    """Of all that the words of a session depend on, apart from their variants."""
    return words_fingerprints({"": session}, settings)[""]


def words_fingerprints(sessions: Mapping[str, SessionMap], settings: Resolved) -> dict[str, str]:
    """Of all that the words of each session depend on, apart from their variants."""
    of_all = (settings.fingerprint("descriptor"), _weights(settings))
    return {
        name: fingerprint_of((session.json["fingerprint"], *of_all))
        for name, session in sessions.items()
    }


def is_described(session: SessionMap, variants: Iterable[str], settings: Resolved) -> bool:
    """Whether a session has words of all ``variants``, made from its present map."""
    words_json = session.folder.words_json
    if recorded_fingerprint(words_json) != words_fingerprint(session, settings):
        return False
    return set(variants) <= set(read_json(words_json)["variants"])


def check_settings(session: SessionMap, settings: Resolved) -> None:
    """WorkspaceError where a session was fused with other settings of fusion."""
    fused = session.json["settings"]["fusion"]
    wanted = settings.tables("fusion")["fusion"]
    for key in wanted:
        if key in fused and fused[key] != wanted[key]:
            raise WorkspaceError(
                f"Session {session.folder.name} was fused with fusion.{key}={fused[key]}, the"
                f" settings are fusion.{key}={wanted[key]}: fuse its log again, or take the other"
                " value."
            )


class _Described:
    """The words of one session, which replace older ones when all submaps are described.

    Several sessions can be on their way at once.
    """

    def __init__(
        self,
        folder: SessionFolder,
        variants: tuple[str, ...],
        settings: Resolved,
        outputs: ExitStack,
    ) -> None:
        self.folder = SessionFolder(folder.path.absolute())  # workers may be in another folder
        session = SessionMap(self.folder)
        self._submaps: list[dict[str, Any]] = session.json["submaps"]
        self._metadata = {key: session.json[key] for key in KEPT_METADATA}
        self._fingerprint = words_fingerprint(session, settings)
        self._variants = variants
        self._settings = settings
        self._end = outputs.enter_context(ExitStack())
        self._output: Path | None = None

    @property
    def submaps(self) -> int:
        return len(self._submaps)

    def tasks(self) -> Iterator[DescribeTask]:
        """One for each submap."""
        road = SessionMap(self.folder).road
        output = self._begun()
        for submap in self._submaps:
            yield DescribeTask(
                self.folder,
                submap["id"],
                submap["ground_z"],
                road(submap),
                self._variants,
                blocks_path(output, submap["id"]),
                self._metadata,
                self._settings,
            )

    def take(self, counts: Iterator[int]) -> int:
        """Take the results of the tasks, and put the words in their place; their number."""
        words = 0
        total = len(self._submaps)
        for done, count in enumerate(islice(counts, total), 1):
            words += count
            progress.report("describe", self.folder.name, done, total, "submaps")
        output = self._begun()
        if not total:
            write_words(blocks_path(output, 0), 0, [], self._metadata)
        self.folder.words_json.unlink(missing_ok=True)  # it must not vouch for other words
        self._end.close()
        content = {
            "fingerprint": self._fingerprint,
            "words": words,
            "variants": list(self._variants),
            "settings": self._settings.tables("descriptor"),
        }
        write_json(self.folder.words_json, content)
        return words

    def _begun(self) -> Path:
        """The folder that the words are written to."""
        if self._output is None:
            self._output = self._end.enter_context(replacing_folder(self.folder.words))
        return self._output


def _weights(settings: Resolved) -> str:
    """Fingerprint of weights and vocabulary given as files; shipped ones belong to the version."""
    paths = [settings.descriptor.weights, settings.descriptor.vocabulary]
    files = [path for path in paths if path is not None and path.is_file()]
    return fingerprint_of(hashlib.sha256(path.read_bytes()).hexdigest() for path in files)

"""Maps -> semantic words of each session."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable, Sequence
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


def _describe(
    work: Workspace,
    folders: Sequence[SessionFolder],
    settings: Resolved,
    engine: Engine,
    overwrite: bool,
) -> Report:
    report = Report()
    # a session is comparable with all others, not only with those that are described now
    sources = [str(read_json(f.session_json)["label_source"]) for f in work.sessions()]
    for folder in folders:
        check_settings(folder, settings)
    keep(work, settings)
    for folder in folders:
        content = read_json(folder.session_json)
        variants = variants_for(str(content["label_source"]), sources, settings)
        if not overwrite and is_described(folder, variants, settings):
            report.kept.append(folder.name)
            continue

        words = _describe_session(folder, content, variants, settings, engine)
        used = settings.tables("descriptor")
        fingerprint = words_fingerprint(folder, settings)
        done = {"fingerprint": fingerprint, "words": words, "variants": list(variants)}
        write_json(folder.words_json, {**done, "settings": used})
        report.done.append(folder.name)
        LOGGER.info("%s: %d words", folder.name, words)
    return report


def words_fingerprint(folder: SessionFolder, settings: Resolved) -> str:
    """Of all that the words of a session depend on, apart from their variants."""
    fused = read_json(folder.session_json)["fingerprint"]
    return fingerprint_of((fused, settings.fingerprint("descriptor"), _weights(settings)))


def is_described(folder: SessionFolder, variants: Iterable[str], settings: Resolved) -> bool:
    """Whether a session has words of all ``variants``, made from its present map."""
    if recorded_fingerprint(folder.words_json) != words_fingerprint(folder, settings):
        return False
    return set(variants) <= set(read_json(folder.words_json)["variants"])


def check_settings(folder: SessionFolder, settings: Resolved) -> None:
    """WorkspaceError where a session was fused with other settings of fusion."""
    fused = read_json(folder.session_json)["settings"]["fusion"]
    wanted = settings.tables("fusion")["fusion"]
    for key in wanted:
        if key in fused and fused[key] != wanted[key]:
            raise WorkspaceError(
                f"Session {folder.name} was fused with fusion.{key}={fused[key]}, the settings"
                f" are fusion.{key}={wanted[key]}: fuse its log again, or take the other value."
            )


def _describe_session(
    folder: SessionFolder,
    content: dict[str, Any],
    variants: tuple[str, ...],
    settings: Resolved,
    engine: Engine,
) -> int:
    """Write the words of all submaps; their number."""
    metadata = {key: content[key] for key in KEPT_METADATA}
    road = SessionMap(folder).road
    submaps = content["submaps"]
    words = 0
    with replacing_folder(folder.words) as output:
        tasks = [
            DescribeTask(
                folder,
                submap["id"],
                submap["ground_z"],
                road(submap),
                variants,
                blocks_path(output, submap["id"]),
                metadata,
                settings,
            )
            for submap in submaps
        ]
        for done, count in enumerate(engine.map(index_submap, tasks), 1):
            words += count
            progress.report("describe", folder.name, done, len(tasks), "submaps")
        if not tasks:
            write_words(blocks_path(output, 0), 0, [], metadata)
        folder.words_json.unlink(missing_ok=True)  # it must not vouch for other words
    return words


def _weights(settings: Resolved) -> str:
    """Fingerprint of weights and vocabulary given as files; shipped ones belong to the version."""
    paths = [settings.descriptor.weights, settings.descriptor.vocabulary]
    files = [path for path in paths if path is not None and path.is_file()]
    return fingerprint_of(hashlib.sha256(path.read_bytes()).hexdigest() for path in files)

"""Maps -> semantic words of each session."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from typing import Any

from semloc_logs import progress
from semloc_logs.engines import Engine
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved
from semloc_logs.stages.inputs import fingerprint_of, recorded_fingerprint
from semloc_logs.stages.report import Report
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

    Raises WorkspaceError where a session is missing or has voxels of another size.
    """
    report = Report()
    folders = work.chosen(names)
    contents = {folder.name: read_json(folder.session_json) for folder in folders}
    sources = [str(content["label_source"]) for content in contents.values()]
    for folder in folders:
        content = contents[folder.name]
        _check_voxel_size(folder.name, content, settings)
        variants = variants_for(str(content["label_source"]), sources, settings)
        descriptor = settings.fingerprint("descriptor")
        parts = (content["fingerprint"], descriptor, _weights(settings), *variants)
        fingerprint = fingerprint_of(parts)
        if not overwrite and recorded_fingerprint(folder.words_json) == fingerprint:
            report.kept.append(folder.name)
            continue

        folder.words_json.unlink(missing_ok=True)
        words = _describe_session(folder, content, variants, settings, engine)
        used = settings.model_dump(mode="json", include={"descriptor"})
        done = {"fingerprint": fingerprint, "words": words, "variants": list(variants)}
        write_json(folder.words_json, {**done, "settings": used})
        report.done.append(folder.name)
        LOGGER.info("%s: %d words", folder.name, words)
    return report


def _check_voxel_size(name: str, content: dict[str, Any], settings: Resolved) -> None:
    fused = content["settings"]["fusion"]["voxel_size"]
    if fused != settings.fusion.voxel_size:
        raise WorkspaceError(
            f"Session {name} was fused with voxels of {fused} m, the settings give"
            f" {settings.fusion.voxel_size} m: add --set fusion.voxel_size={fused},"
            " or fuse it again."
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
    return words


def _weights(settings: Resolved) -> str:
    """Fingerprint of weights and vocabulary given as files; shipped ones belong to the version."""
    paths = [settings.descriptor.weights, settings.descriptor.vocabulary]
    files = [path for path in paths if path is not None and path.is_file()]
    return fingerprint_of(hashlib.sha256(path.read_bytes()).hexdigest() for path in files)

"""`semloc import`: the sequences of a data set as logs, with a truth file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from semloc_logs import progress
from semloc_logs.errors import LogError, SettingsError, did_you_mean
from semloc_logs.experiments.datasets.boreas import boreas_recordings
from semloc_logs.experiments.datasets.kitti import kitti_recordings, semantickitti_recordings
from semloc_logs.experiments.datasets.nclt import nclt_recordings
from semloc_logs.experiments.datasets.recording import Recording, write_recording
from semloc_logs.tables.atomic_files import make_folder, replacing_file

DATASETS: dict[str, Callable[[Path], list[Recording]]] = {
    "kitti": kitti_recordings,
    "semantickitti": semantickitti_recordings,
    "nclt": nclt_recordings,
    "boreas": boreas_recordings,
}


def import_dataset(
    name: str, folder: Path, output: Path, *, overwrite: bool = False
) -> tuple[Path, list[Path]]:
    """Write a log for each sequence below ``folder``; the truth file and the logs.

    Logs that exist stay, unless ``overwrite`` is set. SettingsError for an unknown data set,
    LogError when the folder is not of its form.
    """
    if name not in DATASETS:
        raise SettingsError(
            f"Unknown data set '{name}'.{did_you_mean(name, DATASETS)} "
            f"There are {', '.join(DATASETS)}."
        )
    if not folder.is_dir():
        raise LogError(f"{folder} is not a folder: give the one that the data set was unpacked to.")
    recordings = DATASETS[name](folder)
    make_folder(output)
    logs = []
    for number, recording in enumerate(recordings):
        log = output / f"{recording.name}.mcap"
        if overwrite or not log.exists():
            write_recording(recording, output)
        logs.append(log)
        progress.report("import", "", number + 1, len(recordings), "sequences")
    truth = output / "truth.json"
    entries = _known(truth) | {log.name: {"trajectory": f"{log.stem}.tum"} for log in logs}
    with replacing_file(truth) as temporary:
        temporary.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    return truth, logs


def _known(truth: Path) -> dict[str, object]:
    """Logs of an earlier import into the same folder."""
    try:
        content = json.loads(truth.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}

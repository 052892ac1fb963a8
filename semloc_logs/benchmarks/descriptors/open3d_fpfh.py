"""FPFH beside our descriptor: the same subvolumes of the same maps, described by Open3D in a Python
environment of its own.

Rusu et al., Fast Point Feature Histograms, ICRA 2009. The points are the centres of the occupied
voxels, the support is a sphere as wide as a subvolume about the occupied voxel nearest to its
centre. FPFH does not depend on the heading, so it is told none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from semloc_logs.benchmarks.descriptors.places import Place
from semloc_logs.benchmarks.descriptors.recall import Describe
from semloc_logs.benchmarks.peers.peer_process import run_peer
from semloc_logs.subvolumes.cut import SIZE
from semloc_logs.subvolumes.describe import Described
from semloc_logs.training.pairs import occupied

SECONDS = 6 * 3600.0
# voxels along the edge of the cells that points are thinned to: with all points it takes four times
# as long
CELLS = 2


def fpfh_describes(
    python: str,
    folder: Path,
    places: Iterable[tuple[Place, bool]],
    described: Describe,
    voxel_size: float,
) -> Describe:
    """Describes those ``places`` (and whether each is a query) where ``described`` does; features
    are kept in ``folder``.

    SettingsError when ``python`` cannot be started, SemlocError when Open3D fails.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for place, is_query in places:
        key = _key(place, is_query)
        centre = described(place, is_query).centre
        if not len(centre) or (folder / f"features_{key}.npy").exists():
            continue
        np.save(folder / f"centres_{key}.npy", centre * voxel_size)
        np.save(folder / f"track_{key}.npy", place.track)
        points = (np.argwhere(occupied(place.state)) + place.low + 0.5) * voxel_size
        np.save(folder / f"points_{key}.npy", points.astype(np.float32))
    if any(folder.glob("points_*.npy")):
        _run(python, folder, voxel_size)

    def describe(place: Place, is_query: bool) -> Described:
        centre = described(place, is_query).centre
        if not len(centre):
            return Described(centre, np.zeros((0, 33), np.float32))
        features = np.load(folder / f"features_{_key(place, is_query)}.npy")
        return Described(centre, features.astype(np.float32))

    return describe


def _key(place: Place, is_query: bool) -> str:
    content = hashlib.sha256(place.state.tobytes())
    content.update(
        place.low.tobytes()
        + np.float64(place.ground_z).tobytes()
        + place.track.tobytes()
        + bytes([is_query])
    )
    return content.hexdigest()[:24]


def _run(python: str, folder: Path, voxel_size: float) -> None:
    run_peer(
        "fpfh",
        python,
        [str(folder), repr(SIZE / 2 * voxel_size), repr(CELLS * voxel_size)],
        SECONDS,
    )
    for name in ("points", "centres", "track"):
        for path in folder.glob(f"{name}_*.npy"):
            path.unlink()

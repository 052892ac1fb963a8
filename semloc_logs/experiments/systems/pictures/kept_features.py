"""Features of pictures as files: databases of several scenarios have many of the same pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from semloc_logs.arrays import U8
from semloc_logs.experiments.kept_files import kept_file
from semloc_logs.experiments.system import Picture
from semloc_logs.experiments.system_version import module_version
from semloc_logs.experiments.systems.pictures import local_features, picture_pose
from semloc_logs.experiments.systems.pictures.local_features import Features
from semloc_logs.experiments.systems.pictures.picture_pose import points_of

Extract = Callable[[U8], Features]  # a function with a name of its own


def kept_features(extract: Extract, folder: Path) -> Callable[[Picture], Path]:
    """A function from a picture to the file in ``folder`` with its features by ``extract`` and
    their points (n, 3), base frame, NaN where the depth is unknown.

    Files are of the code of the features and points: other code makes others.
    """
    version = [module_version(module.__name__) for module in (local_features, picture_pose)]

    def file(picture: Picture) -> Path:
        def make(temporary: Path) -> None:
            features = extract(picture.image)
            with temporary.open("wb") as stream:
                np.savez(stream, *features, points_of(picture, features.xy))

        key = hashlib.sha256(repr((extract.__name__, version)).encode())
        for part in picture:
            key.update(repr((part.shape, part.dtype)).encode())
            key.update(np.ascontiguousarray(part).tobytes())
        return kept_file(folder / f"{key.hexdigest()[:24]}.npz", make)

    return file

"""Features of pictures as files: databases of several scenarios have many of the same pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.experiments.system_version import module_version
from semloc_logs.experiments.systems.pictures import local_features
from semloc_logs.experiments.systems.pictures.local_features import Features
from semloc_logs.tables.atomic_files import replacing_file

U8 = NDArray[np.uint8]
Extract = Callable[[U8], Features]  # a function with a name of its own


def kept_features(extract: Extract, folder: Path) -> Extract:
    """The same as ``extract``, with a file for each picture (h, w, 3) in ``folder``.

    Files are of the code of the features: other code makes others.
    """
    version = module_version(local_features.__name__)

    def features(image: U8) -> Features:
        key = hashlib.sha256(repr((extract.__name__, version, image.shape)).encode())
        key.update(np.ascontiguousarray(image).tobytes())
        path = folder / f"{key.hexdigest()[:24]}.npz"
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            with replacing_file(path) as temporary, temporary.open("wb") as file:
                np.savez(file, *extract(image))
        with np.load(path) as arrays:
            return Features(*(arrays[name] for name in arrays.files))

    return features

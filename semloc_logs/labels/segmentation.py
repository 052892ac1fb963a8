"""The user's ONNX model: camera picture -> Cityscapes train ids of its pixels.

It runs in onnxruntime (the extra ``onnx``) or, where that is not installed, in OpenCV, in as many
threads as ``labels.threads`` allows. ``labels.memory`` bounds the memory of onnxruntime, and the
size of input and output of both.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import U8, U32
from semloc_logs.errors import SettingsError
from semloc_logs.labels.segmentation_spec import Spec, read_spec
from semloc_logs.labels.space import UNLABELLED, UNPAINTED, is_file_name, read_space
from semloc_logs.settings import Labels

_MEMORY: int = Labels.model_fields["memory"].default  # bytes
Net = Callable[[NDArray[Any]], NDArray[Any]]  # a batch of one picture -> the output


def fingerprint(settings: Labels) -> str:
    """Hashes of the files that ``settings`` name: model, spec, label spaces; "" without any.

    SettingsError if one is missing.
    """
    paths = []
    if settings.source == "onnx":
        model, spec = _named(settings)
        paths = [model, spec]
        named = read_spec(spec).space or ""
        paths += [
            p for p in (spec.parent / named, Path(named)) if is_file_name(named) and p.is_file()
        ]
    if settings.space is not None and is_file_name(settings.space):
        read_space(settings.space)
        paths.append(Path(settings.space))
    return " ".join(_digest(path) for path in paths)


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:16]
    except OSError as error:
        raise SettingsError(
            f"The file {path} cannot be read ({error.strerror or error}): name another."
        ) from None


def _named(settings: Labels) -> tuple[Path, Path]:
    if settings.model is None or settings.spec is None:
        raise SettingsError(
            "labels.source=onnx needs a model and its spec: give --seg-model MODEL.onnx --seg-spec "
            "SPEC.yaml."
        )
    return settings.model, settings.spec


class Segmenter:
    """A model with its spec.

    :meth:`train_ids` depends on the picture alone: the same picture gives the same labels.
    """

    def __init__(
        self,
        net: Net,
        runtime: str,
        spec: Spec,
        spec_path: Path,
        model_path: Path,
        memory: int = _MEMORY,
    ) -> None:
        self._memory = memory
        self._net, self._runtime, self._spec, self._path = net, runtime, spec, model_path
        self._space = spec.label_space(spec_path)
        ignored = spec.ignored(self._space)
        ids = np.arange(max(self._space.targets, default=0) + 1)
        # the last is for pixels that a model itself leaves out
        self._table = np.append(self._space.train_ids(ids), np.uint8(UNLABELLED))
        self._table[sorted(ignored)] = UNLABELLED

    @classmethod
    def open(cls, settings: Labels) -> Segmenter:
        """The model that ``labels.model`` and ``labels.spec`` name.

        SettingsError when one of them is missing or cannot be used.
        """
        model_path, spec_path = _named(settings)
        spec = read_spec(spec_path)
        if not model_path.is_file():
            raise SettingsError(f"Model {model_path} is missing: --seg-model takes an ONNX file.")
        rows, columns = spec.input.size
        _check_memory(model_path, "an input", 3 * 4 * rows * columns, settings.memory)
        net, runtime = _load(model_path, spec, settings)
        return cls(net, runtime, spec, spec_path, model_path, settings.memory)

    def to_json(self) -> dict[str, Any]:
        """For session.json."""
        return {
            "path": str(self._path),
            "runtime": self._runtime,
            "space": self._space.name,
            "unknown_classes": list(self._space.unknown),
        }

    def train_ids(self, picture: NDArray[np.uint8] | NDArray[np.uint16]) -> U32:
        """Train ids (h, w) of a picture (h, w) or (h, w, 3) RGB; UNPAINTED where it is cropped."""
        spec = self._spec.input
        height, width = picture.shape[:2]
        top, bottom, left, right = (
            round(share * size)
            for share, size in zip(spec.crop, (height, height, width, width), strict=True)
        )
        inner = _eight_bits(picture)[top : height - bottom, left : width - right]
        if not inner.size:
            return np.full((height, width), UNPAINTED, np.uint32)
        batch, box = self._batch(inner)
        ids = self._ids(self._net(batch))
        # the part of the output that is the picture, at whole pixels of it
        rows, columns = ids.shape
        part = ids[
            round(box[0] * rows) : max(round(box[1] * rows), round(box[0] * rows) + 1),
            round(box[2] * columns) : max(round(box[3] * columns), round(box[2] * columns) + 1),
        ]
        out = np.full((height, width), UNPAINTED, np.uint32)
        out[top : height - bottom, left : width - right] = cv2.resize(
            self._table[part],
            (inner.shape[1], inner.shape[0]),
            interpolation=cv2.INTER_NEAREST_EXACT,
        )
        return out

    def _batch(self, picture: U8) -> tuple[NDArray[Any], tuple[float, float, float, float]]:
        """The input of the model, and the share of it that the picture fills.

        The share is the first and last of rows and of columns.
        """
        spec = self._spec.input
        rows, columns = spec.size
        box = (0.0, 1.0, 0.0, 1.0)
        if spec.resize == "letterbox":
            factor = min(rows / picture.shape[0], columns / picture.shape[1])
            inner_rows = max(round(picture.shape[0] * factor), 1)
            inner_columns = max(round(picture.shape[1] * factor), 1)
            y = (rows - inner_rows) // 2
            x = (columns - inner_columns) // 2
            canvas = np.zeros((rows, columns, 3), np.uint8)
            canvas[y : y + inner_rows, x : x + inner_columns] = _resized(
                picture, inner_rows, inner_columns
            )
            picture = canvas
            box = (y / rows, (y + inner_rows) / rows, x / columns, (x + inner_columns) / columns)
        else:
            picture = _resized(picture, rows, columns)
        if spec.colours == "BGR":
            picture = picture[..., ::-1]
        values: NDArray[Any] = picture
        if spec.type == "float32":
            values = (
                picture * np.float32(spec.scale) - np.asarray(spec.mean, np.float32)
            ) / np.asarray(spec.std, np.float32)
        values = values.transpose(2, 0, 1) if spec.layout == "NCHW" else values
        return np.ascontiguousarray(values[None]), box

    def _ids(self, output: NDArray[Any]) -> NDArray[np.intp]:
        """Class ids (rows, columns) of the model's output.

        SettingsError when the output has not the form that the spec describes.
        """
        spec = self._spec.output
        # classes are found in a copy and kept as numbers of 8 bytes
        needed = 2 * output.nbytes + 8 * output.size
        _check_memory(self._path, "an output", needed, self._memory)
        given = " x ".join(map(str, output.shape))
        image = (
            output.reshape([n for n in output.shape if n != 1] or [1])
            if output.ndim > 3 or spec.kind == "ids"
            else output
        )
        if not output.size or output.dtype.kind not in "biuf":
            raise SettingsError(
                f"Model {self._path} gives {given} values of type {output.dtype}: output.name may "
                "name another output."
            )
        classes = len(self._table) - 1
        if spec.kind == "ids":
            if image.ndim != 2:
                raise SettingsError(
                    f"Model {self._path} gives {given} values, not a picture of ids: "
                    "output.kind may be 'logits'."
                )
            ids: NDArray[np.intp] = np.rint(image).astype(np.intp)
            left_out = (ids == -1) | ((ids == UNLABELLED) & (classes <= UNLABELLED))
            strange = ids[((ids < 0) | (ids >= classes)) & ~left_out]
            if len(strange):
                raise SettingsError(
                    f"Model {self._path} gives the class {strange[0]}, but {self._space.name} ends "
                    f"at {classes - 1}."
                )
            return np.where(left_out, classes, ids)
        if image.ndim != 3 or (image.shape[0] == 1 and classes > 1):
            raise SettingsError(
                f"Model {self._path} gives {given} values, not classes x rows x columns: "
                "output.kind may be 'ids'."
            )
        axis = 0 if spec.layout == "CHW" else 2
        if image.shape[axis] != classes:
            raise SettingsError(
                f"Model {self._path} gives {given} values, {image.shape[axis]} classes in layout "
                f"{spec.layout}, "
                f"but {self._space.name} has {classes}: give the model's own list of classes, or "
                "another layout."
            )
        best: NDArray[np.intp] = np.argmax(image, axis=axis)
        return best


def _eight_bits(picture: NDArray[np.uint8] | NDArray[np.uint16]) -> U8:
    """(h, w, 3), of grey three times the same."""
    eight = (
        (picture >> 8).astype(np.uint8)
        if picture.dtype == np.uint16
        else picture.astype(np.uint8, copy=False)
    )
    return np.repeat(eight[..., None], 3, axis=2) if eight.ndim == 2 else eight


def _resized(picture: U8, rows: int, columns: int) -> U8:
    if picture.shape[:2] == (rows, columns):
        return picture
    shrinks = rows * columns < picture.shape[0] * picture.shape[1]
    resized = cv2.resize(
        np.ascontiguousarray(picture),
        (columns, rows),
        interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR,
    )
    return np.asarray(resized, np.uint8)


def _check_memory(path: Path, what: str, size: int, memory: int) -> None:
    """SettingsError where a model has an input or an output that is too large."""
    if size > memory:
        raise SettingsError(
            f"Model {path} has {what} that takes {size} bytes, more than labels.memory ({memory}): "
            "choose a smaller one, or set labels.memory."
        )


def _load(path: Path, spec: Spec, settings: Labels) -> tuple[Net, str]:
    try:
        import onnxruntime
    except ImportError:
        return _load_cv2(path, spec, settings.threads), f"opencv {cv2.__version__}"
    return _load_onnxruntime(
        onnxruntime, path, spec, settings
    ), f"onnxruntime {onnxruntime.__version__}"


def _bound_memory(runtime: Any, memory: int) -> None:
    """Lets the sessions of this process take at most so many bytes together."""
    place = runtime.OrtMemoryInfo(
        "Cpu", runtime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, runtime.OrtMemType.DEFAULT
    )
    # grows by the bytes that are needed, not by powers of two
    arena = {
        "max_mem": memory,
        "arena_extend_strategy": 1,
        "initial_chunk_size_bytes": -1,
        "max_dead_bytes_per_chunk": -1,
    }
    runtime.create_and_register_allocator(place, runtime.OrtArenaCfg(arena))


def _load_onnxruntime(runtime: Any, path: Path, spec: Spec, settings: Labels) -> Net:
    _bound_memory(runtime, settings.memory)
    options = runtime.SessionOptions()
    options.add_session_config_entry("session.use_env_allocators", "1")
    options.intra_op_num_threads, options.inter_op_num_threads = settings.threads, 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4
    try:
        session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime raises many types, and the file may be anything
        raise SettingsError(
            _too_large(path, error, settings)
            or f"Model {path} cannot be read as ONNX: {_short(error)}."
        ) from None
    inputs = {i.name: i for i in session.get_inputs()}
    outputs = [o.name for o in session.get_outputs()]
    name = spec.input.name or (next(iter(inputs)) if len(inputs) == 1 else "")
    if name not in inputs:
        raise SettingsError(
            f"Model {path} has no input '{name}': name one of {', '.join(inputs)} as input.name in "
            "its spec."
        )
    output = spec.output.name or outputs[0]
    if output not in outputs:
        raise SettingsError(
            f"Model {path} has no output '{output}': name one of {', '.join(outputs)} as "
            "output.name in its spec."
        )
    _check_shape(path, spec, inputs[name].shape, inputs[name].type)

    def run(batch: NDArray[Any]) -> NDArray[Any]:
        try:
            return np.asarray(session.run([output], {name: batch})[0])
        except Exception as error:
            raise SettingsError(
                _too_large(path, error, settings)
                or f"Model {path} fails on an input of {' x '.join(map(str, batch.shape))}: "
                f"{_short(error)}."
            ) from None

    return run


def _too_large(path: Path, error: Exception, settings: Labels) -> str:
    """The sentence about a model that needs more memory; "" for another error."""
    if "Available memory of" not in str(error):
        return ""
    return (
        f"Model {path} needs more memory than labels.memory ({settings.memory} bytes): choose a "
        "smaller one, or set labels.memory."
    )


def _check_shape(path: Path, spec: Spec, shape: list[Any], type_: str) -> None:
    rows, columns = spec.input.size
    wanted = [1, 3, rows, columns] if spec.input.layout == "NCHW" else [1, rows, columns, 3]
    fits = len(shape) == 4 and all(
        not isinstance(s, int) or s < 1 or s == w for s, w in zip(shape, wanted, strict=True)
    )
    if not fits:
        raise SettingsError(
            f"Model {path} takes an input of {' x '.join(map(str, shape))}, but its spec has "
            f"{' x '.join(map(str, wanted))} "
            f"({spec.input.layout}): correct input.size or input.layout."
        )
    types = {"tensor(float)": "float32", "tensor(uint8)": "uint8"}
    if types.get(type_) != spec.input.type:
        raise SettingsError(
            f"Model {path} takes {type_}, but its spec has input.type {spec.input.type}."
        )


def _load_cv2(path: Path, spec: Spec, threads: int) -> Net:
    cv2.setNumThreads(threads)
    try:
        net = cv2.dnn.readNetFromONNX(str(path))
    except (cv2.error, RuntimeError) as error:
        raise SettingsError(
            f"Model {path} cannot be read by OpenCV: {_short(error)}; install onnxruntime (pip "
            "install 'semloc_logs[onnx]')."
        ) from None

    def run(batch: NDArray[Any]) -> NDArray[Any]:
        try:
            net.setInput(batch, spec.input.name or "")
            return np.asarray(net.forward(spec.output.name) if spec.output.name else net.forward())
        except (cv2.error, RuntimeError) as error:
            raise SettingsError(
                f"Model {path} fails in OpenCV: {_short(error)}; install onnxruntime (pip install "
                "'semloc_logs[onnx]')."
            ) from None

    return run


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:200].rstrip(".")

"""Messages with pictures, raw and compressed, and the calibrations of cameras."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.frames import WHOLE_PICTURE, Camera, DepthFrame, Frame, Header, ImageFrame, Region
from semloc_logs.logs.messages import image_codecs
from semloc_logs.logs.messages.definitions import UndecodableError, binary
from semloc_logs.logs.messages.headers import Convert, foxglove, ros


def _picture(header: Header, pixels: Any, encoding: str, depth: bool) -> Iterator[Frame]:
    if depth:
        step = image_codecs.METRE if pixels.dtype.kind == "f" else image_codecs.MILLIMETRE
        yield DepthFrame(header, image_codecs.depth_metres(pixels), step)
    else:
        yield ImageFrame(header, pixels, encoding)


def _raw(header: Header, m: Any) -> Iterator[Frame]:
    encoding = str(m.encoding)
    big_endian = bool(getattr(m, "is_bigendian", False))
    of_depth = image_codecs.is_depth(header.topic, encoding)
    size = (int(m.width or 0), int(m.height or 0), int(m.step or 0))
    layout = image_codecs.Layout(*size, encoding, big_endian)
    pixels = image_codecs.decode_raw(binary(m.data), layout, of_depth=of_depth)
    yield from _picture(header, pixels, encoding, of_depth)


def _compressed(header: Header, m: Any) -> Iterator[Frame]:
    format_ = str(m.format or "")
    data = binary(m.data)
    if "compresseddepth" in format_.lower() or header.topic.endswith("/compressedDepth"):
        metres = image_codecs.decode_compressed_depth(data, format_)
        is_float = image_codecs.is_inverse_depth(format_)
        step = image_codecs.METRE if is_float else image_codecs.MILLIMETRE
        yield DepthFrame(header, metres, step)
        return
    pixels = image_codecs.decode_compressed(data)
    depth = pixels.ndim == 2 and pixels.dtype == np.uint16
    # image_transport names the encoding before compression first
    recorded = format_.partition(";")[0].strip()
    depth = depth and image_codecs.is_depth(header.topic, recorded if ";" in format_ else "mono16")
    yield from _picture(header, pixels, format_, depth)


def _camera(header: Header, m: Any) -> Iterator[Frame]:
    def values(name: str, shape: tuple[int, int] | None) -> F64:
        recorded = getattr(m, name, None)
        recorded = getattr(m, name.lower(), ()) if recorded is None else recorded
        array = np.array(() if recorded is None else recorded, float)
        if not np.isfinite(array).all():
            raise UndecodableError(f"its matrix {name} is not finite")
        if shape is None:
            return array.reshape(-1)
        return array.reshape(shape) if array.size else np.zeros(shape)

    K = values("K", (3, 3))
    D = values("D", None)
    R = values("R", (3, 3))
    P = values("P", (3, 4))
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise UndecodableError("its camera is not calibrated (the focal length is zero)")
    if len(D) > 14:  # no model of the field has more
        raise UndecodableError(f"it has {len(D)} distortion coefficients")
    if not R.any():
        R = np.eye(3)
    if not P.any():
        P = np.hstack([K, np.zeros((3, 1))])
    yield Camera(
        header,
        int(m.width or 0),
        int(m.height or 0),
        K,
        D,
        R,
        P,
        str(m.distortion_model or ""),
        # foxglove.CameraCalibration has neither
        (int(getattr(m, "binning_x", 0) or 1), int(getattr(m, "binning_y", 0) or 1)),
        _region(getattr(m, "roi", None)),
    )


def _region(roi: Any) -> Region:
    if roi is None:
        return WHOLE_PICTURE
    return Region(int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height))


CONVERTERS: dict[str, Convert] = {
    "sensor_msgs/msg/Image": ros(_raw),
    "sensor_msgs/msg/CompressedImage": ros(_compressed),
    "sensor_msgs/msg/CameraInfo": ros(_camera),
    "foxglove.RawImage": foxglove(_raw),
    "foxglove.CompressedImage": foxglove(_compressed),
    "foxglove.CameraCalibration": foxglove(_camera),
}

"""Pictures and depth images as recorded (raw, JPEG, PNG, compressedDepth) to arrays."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32
from semloc_logs.logs.messages.definitions import UndecodableError
from semloc_logs.logs.messages.rvl import decode_rvl

Image = NDArray[np.uint8] | NDArray[np.uint16]

# encoding: (type of a value, channels, OpenCV conversion to RGB or None)
_RAW: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8uc1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "16uc1": ("u2", 1, None),
    "16sc1": ("i2", 1, None),
    "32sc1": ("i4", 1, None),
    "32fc1": ("f4", 1, None),
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "8uc3": ("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "8uc4": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "rgb16": ("u2", 3, None),
    "bgr16": ("u2", 3, cv2.COLOR_BGR2RGB),
    "rgba16": ("u2", 4, cv2.COLOR_RGBA2RGB),
    "bgra16": ("u2", 4, cv2.COLOR_BGRA2RGB),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
}
# OpenCV names a Bayer pattern after its second row and column
for _pattern, _code in (
    ("rggb", cv2.COLOR_BayerBG2RGB),
    ("bggr", cv2.COLOR_BayerRG2RGB),
    ("gbrg", cv2.COLOR_BayerGR2RGB),
    ("grbg", cv2.COLOR_BayerGB2RGB),
):
    _RAW[f"bayer_{_pattern}8"] = ("u1", 1, _code)
    _RAW[f"bayer_{_pattern}16"] = ("u2", 1, _code)

# one step of a depth image, m: of whole numbers, and of floats
MILLIMETRE = 0.001
METRE = 1.0
_LABEL_WORDS = ("label", "segment", "semantic", "mask", "class")
_MAX_PIXELS = 1 << 26  # twice 8K
_MAX_BYTES = 1 << 28
_DEFLATE_MOST = 1100  # deflate shrinks at most 1032-fold
_JPEG_MOST = 512  # pixels a byte: a block of 64 takes a bit at least
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type; a palette becomes colour
_PNG = b"\x89PNG\r\n\x1a\n"  # the first bytes
# rows and neighbours that tell the order of bytes; in the wrong one a step of 1 is a step of 256
_ROWS, _FEWEST_PIXELS = 32, 200
_ROUGHER = 30.0
_COMPRESSED_DEPTH_HEAD = struct.Struct("<iff")


def _is_rough_beside(pixels: NDArray[np.uint16], other: np.dtype[Any], *, of_depth: bool) -> bool:
    """Whether neighbours (h, w, 1) differ far more than in the ``other`` order of bytes.

    Writers fill in the flag for the order of bytes wrongly; pictures are smooth in one order only.
    Only depths are judged by the neighbours that differ: a camera's depths are the same for most,
    and so are labels, which may count in steps of 256.
    """
    rows = pixels[:: max(1, len(pixels) // _ROWS), :, 0]

    def roughness(values: NDArray[np.uint16]) -> float:
        steps = np.abs(np.diff(values.astype(np.int64), axis=1))
        both = (values[:, 1:] > 0) & (values[:, :-1] > 0)
        if of_depth:
            both &= steps > 0
        return float(np.median(steps[both])) if both.sum() >= _FEWEST_PIXELS else 0.0

    return roughness(rows) > _ROUGHER * max(roughness(rows.view(other)), 1.0)


class Layout(NamedTuple):
    """How the bytes of a raw picture are to be read; ``step`` is the bytes of a row."""

    width: int
    height: int
    step: int
    encoding: str
    big_endian: bool


def decode_raw(data: bytes | memoryview, layout: Layout, *, of_depth: bool = False) -> Image | F32:
    """(h, w), (h, w, 3) RGB, or float32 (h, w) for 32FC1. ``of_depth``: the pixels are depths.

    UndecodableError when the size does not fit the data.
    """
    width, height, step, encoding, big_endian = layout
    try:
        kind, channels, conversion = _RAW[encoding.strip().lower()]
    except KeyError:
        raise UndecodableError(f"the image encoding {encoding[:40]!r} is not supported") from None
    value = np.dtype((">" if big_endian else "<") + kind)
    row = width * channels * value.itemsize
    step = max(step, row) if height > 1 else row
    if width <= 0 or height <= 0 or (height - 1) * step + row > len(data):
        raise UndecodableError(
            f"{width} x {height} pixels of {encoding} do not fit its {len(data)} bytes"
        )
    # a camera's picture may be the half of a wider one; depths are not
    if of_depth and height > 1 and step > row and step % row == 0:
        raise UndecodableError(
            f"its rows of {step} bytes are {step // row} times as long as {width} pixels of"
            f" {encoding}: its encoding, width or step is wrong"
        )
    shape = (height, width, channels)
    strides = (step, channels * value.itemsize, value.itemsize)
    strided = np.ndarray(shape, value, buffer=data, strides=strides)
    if value.str[1:] == "u2" and channels == 1:
        other = value.newbyteorder()
        if _is_rough_beside(strided, other, of_depth=of_depth):
            strided = strided.view(other)
    pixels: Any = np.ascontiguousarray(strided, value.newbyteorder("="))
    if channels == 1:
        pixels = pixels[:, :, 0]
    if value.kind == "i":
        pixels = _without_sign(pixels)
    if conversion is None:
        return cast("Image | F32", pixels)
    try:
        return cast("Image", cv2.cvtColor(pixels, conversion))
    except cv2.error as error:
        raise UndecodableError(
            f"{width} x {height} pixels of {encoding} cannot be converted"
        ) from error


def _without_sign(pixels: Any) -> NDArray[np.uint16]:
    """Signed values as 16 bits: below 0 is nothing. UndecodableError where they do not fit."""
    if int(pixels.max()) > np.iinfo(np.uint16).max:
        raise UndecodableError(f"its value {int(pixels.max())} does not fit 16 bits")
    return np.asarray(np.maximum(pixels, 0), np.uint16)


def decode_compressed(data: bytes | memoryview) -> Image:
    """A JPEG or PNG picture, grey as (h, w) and colour as (h, w, 3) RGB; 16 bits stay 16 bits."""
    data = bytes(data)
    _check_claim(data)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise UndecodableError("its picture is damaged") from error
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise UndecodableError("its picture is damaged")
    if pixels.ndim == 2:
        return cast("Image", pixels)
    if pixels.shape[2] == 2:  # grey with opacity
        return cast("Image", np.ascontiguousarray(pixels[:, :, 0]))
    return cast(
        "Image",
        cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGB),
    )


def decode_compressed_depth(data: bytes | memoryview, format_: str) -> F32:
    """Metres (h, w) of ROS's compressedDepth.

    12 bytes of quantisation parameters, then a PNG or RVL picture of 16 bits. ``format_`` begins
    with the encoding of the picture before compression; the bytes tell PNG from RVL.
    """
    if len(data) < _COMPRESSED_DEPTH_HEAD.size:
        raise UndecodableError("its depth image is cut off")
    # some publishers leave the parameters out
    has_head = bytes(data[: len(_PNG)]) != _PNG
    _, quant_a, quant_b = _COMPRESSED_DEPTH_HEAD.unpack_from(data) if has_head else (0, 0.0, 0.0)
    body = data[_COMPRESSED_DEPTH_HEAD.size :] if has_head else data
    is_rvl = "rvl" in format_.lower() and bytes(body[: len(_PNG)]) != _PNG
    raw = decode_rvl(body) if is_rvl else decode_compressed(body)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise UndecodableError("its depth image is not a picture of 16 bits")
    if is_inverse_depth(format_):
        if not has_head:
            raise UndecodableError("its depth image lacks the parameters of its inverse depths")
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            metres = np.float32(quant_a) / (raw.astype(np.float32) - np.float32(quant_b))
        metres[raw == 0] = 0
        return depth_metres(metres)
    return depth_metres(raw)


def is_inverse_depth(format_: str) -> bool:
    """Whether a compressedDepth of this format holds inverse depths, of a float picture."""
    return format_.strip().lower().startswith("32fc1")


def depth_metres(raw: Image | F32) -> F32:
    """Metres (h, w) of millimetres (uint16) or metres (float32); 0 where nothing was measured."""
    if raw.dtype == np.uint16:
        metres = raw.astype(np.float32) * np.float32(0.001)
        metres[raw == 65535] = 0
        return metres
    metres = np.array(raw, np.float32)
    metres[~(np.isfinite(metres) & (metres > 0))] = 0
    return metres


def is_depth(topic: str, encoding: str) -> bool:
    """Whether a raw picture is depth.

    32FC1, 16 bits unless they are called labels, mono16 only if called depth.
    """
    name = topic.lower()
    encoding = encoding.strip().lower()
    if encoding == "32fc1":
        return True
    if encoding in ("16uc1", "16sc1"):
        return "depth" in name or not any(word in name for word in _LABEL_WORDS)
    return encoding == "mono16" and "depth" in name


def _check_claim(data: bytes) -> None:
    """UndecodableError when the size in the head of a JPEG or PNG cannot be true.

    Before anything is allocated for it.
    """
    if data.startswith(_PNG):
        if len(data) < 33 or data[12:16] != b"IHDR" or data[25] not in _PNG_CHANNELS:
            raise UndecodableError("its PNG picture is damaged")
        _check_chunks(data)
        width, height, depth, colour = struct.unpack_from(">IIBB", data, 16)
        values = width * height * _PNG_CHANNELS[colour]
        stored = height * (width * (1 if colour == 3 else _PNG_CHANNELS[colour]) * depth // 8)
        too_many = stored > _DEFLATE_MOST * len(data) or values * max(1, depth // 8) > _MAX_BYTES
    elif data.startswith(b"\xff\xd8"):
        width, height = _jpeg_size(data)
        too_many = width * height > _JPEG_MOST * len(data)
    else:
        raise UndecodableError("its picture is neither JPEG nor PNG")
    if too_many or width * height > _MAX_PIXELS:
        raise UndecodableError(f"its {len(data)} bytes claim {width} x {height} pixels")


def _check_chunks(data: bytes) -> None:
    """UndecodableError when a chunk of a PNG claims more bytes than there are.

    The decoder would allocate memory for them.
    """
    position = 8
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        position += 12 + length
        if position > len(data):
            raise UndecodableError("its PNG picture is cut off or damaged")
        if data[position - length - 8 : position - length - 4] == b"IEND":
            return


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height in the frame header of a JPEG picture."""
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
        elif marker in (0x01, *range(0xD0, 0xD9)):
            position += 2
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, position + 5)
            return int(width), int(height)
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    raise UndecodableError("its JPEG picture is damaged")

"""Raw, compressed and depth pictures."""

import contextlib
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.logs.messages.definitions import UndecodableError
from semloc_logs.logs.messages.image_codecs import (
    Layout,
    decode_compressed,
    decode_compressed_depth,
    decode_raw,
    depth_metres,
    is_depth,
)
from semloc_logs.logs.messages.rvl import decode_rvl


def png(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    ok, data = cv2.imencode(".png", pixels)
    assert ok
    return bytes(data)


@pytest.mark.parametrize(
    ("encoding", "data", "expected"),
    [
        ("mono8", bytes([1, 2]), [[1, 2]]),
        ("8UC1", bytes([1, 2]), [[1, 2]]),
        ("mono16", struct.pack("<HH", 1, 513), [[1, 513]]),
        ("rgb8", bytes([1, 2, 3, 4, 5, 6]), [[[1, 2, 3], [4, 5, 6]]]),
        ("bgr8", bytes([1, 2, 3, 4, 5, 6]), [[[3, 2, 1], [6, 5, 4]]]),
        ("8UC3", bytes([1, 2, 3, 4, 5, 6]), [[[3, 2, 1], [6, 5, 4]]]),
        ("rgba8", bytes([1, 2, 3, 9, 4, 5, 6, 9]), [[[1, 2, 3], [4, 5, 6]]]),
        ("bgra8", bytes([1, 2, 3, 9, 4, 5, 6, 9]), [[[3, 2, 1], [6, 5, 4]]]),
        ("32FC1", struct.pack("<ff", 1.5, 2.5), [[1.5, 2.5]]),
    ],
)
def test_two_pixels_by_hand(encoding: str, data: bytes, expected: list[object]) -> None:
    assert decode_raw(data, Layout(2, 1, len(data), encoding, False)).tolist() == expected


def test_row_padding_and_byte_order() -> None:
    data = struct.pack(">HHxxHHxx", 1, 2, 3, 4)
    assert decode_raw(data, Layout(2, 2, 6, "16UC1", True)).tolist() == [[1, 2], [3, 4]]


def test_signed_values() -> None:
    """32SC1 carries labels, 16SC1 depth; below 0 is nothing."""
    pixels = decode_raw(struct.pack("<hh", -1, 1500), Layout(2, 1, 4, "16SC1", big_endian=False))
    assert pixels.tolist() == [[0, 1500]]
    pixels = decode_raw(struct.pack(">ii", 7, 40_000), Layout(2, 1, 8, "32SC1", big_endian=True))
    assert pixels.dtype == np.dtype(np.uint16)
    assert pixels.tolist() == [[7, 40_000]]
    with pytest.raises(UndecodableError, match="70000 does not fit 16 bits"):
        decode_raw(struct.pack("<i", 70_000), Layout(1, 1, 4, "32SC1", big_endian=False))


@pytest.mark.parametrize(
    ("pattern", "site"), [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))]
)
def test_bayer_patterns_put_red_where_it_is(pattern: str, site: tuple[int, int]) -> None:
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[site[0] :: 2, site[1] :: 2] = 200  # light on the red sites only
    rgb = decode_raw(mosaic.tobytes(), Layout(8, 8, 8, f"bayer_{pattern}8", False))
    assert rgb[2:6, 2:6, 0].min() == 200
    assert rgb[2:6, 2:6, 1:].max() == 0


@pytest.mark.parametrize(
    ("width", "height", "encoding"),
    [(3, 1, "mono8"), (2**31, 2**31, "rgb8"), (0, 1, "mono8"), (1, 1, "h264"), (-1, -1, "mono8")],
)
def test_claims_beyond_the_data_are_refused(width: int, height: int, encoding: str) -> None:
    with pytest.raises(UndecodableError):
        decode_raw(b"\0\0", Layout(width, height, 0, encoding, False))


def test_png_keeps_grey_and_16_bits_and_gives_rgb() -> None:
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert decode_compressed(png(grey)).tolist() == grey.tolist()
    deep = (np.arange(12, dtype=np.uint16) * 5000).reshape(3, 4)
    image = decode_compressed(png(deep))
    assert image.dtype == np.uint16
    assert image.tolist() == deep.tolist()
    blue_first = np.zeros((2, 2, 3), np.uint8)
    blue_first[..., 0] = 255
    assert decode_compressed(png(blue_first))[0, 0].tolist() == [0, 0, 255]


def test_jpeg() -> None:
    ok, data = cv2.imencode(".jpg", np.full((16, 24, 3), (10, 120, 240), np.uint8))
    assert ok
    image = decode_compressed(bytes(data))
    assert image.shape == (16, 24, 3)
    assert np.abs(image[8, 8].astype(int) - [240, 120, 10]).max() < 6


def test_a_png_that_claims_gigapixels_is_refused_before_it_is_decoded() -> None:
    data = bytearray(png(np.zeros((2, 2), np.uint8)))
    data[16:24] = struct.pack(">II", 30_000, 30_000)
    with pytest.raises(UndecodableError, match="30000 x 30000"):
        decode_compressed(bytes(data))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8",
        b"\xff\xd8\xff\xe0\0\0",
        b"GIF89a",
        b"\x89PNG\r\n\x1a\n",
        b"\xff\xd8" + b"\xff" * 40,
    ],
)
def test_bytes_that_are_not_a_picture(data: bytes) -> None:
    with pytest.raises(UndecodableError):
        decode_compressed(data)


def test_depth_units_and_holes() -> None:
    millimetres = np.array([[0, 1500, 65535]], np.uint16)
    np.testing.assert_allclose(depth_metres(millimetres), [[0, 1.5, 0]])
    metres = np.array([[np.nan, 1.5, -1, np.inf]], np.float32)
    assert depth_metres(metres).tolist() == [[0, 1.5, 0, 0]]


def test_compressed_depth_in_millimetres_and_as_inverse_depth() -> None:
    raw = np.array([[0, 1000, 2500]], np.uint16)
    depth_decoded = decode_compressed_depth(
        struct.pack("<iff", 0, 0, 0) + png(raw), "16UC1; compressedDepth png"
    )
    np.testing.assert_allclose(depth_decoded, [[0, 1.0, 2.5]])
    quant_a, quant_b = 10100.0, -9.0
    depth = np.array([0.5, 2.0, 9.0])
    coded = np.array([[0, *np.round(quant_a / depth + quant_b)]], np.uint16)
    head = struct.pack("<iff", 0, quant_a, quant_b)
    depth_decoded = decode_compressed_depth(head + png(coded), "32FC1; compressedDepth png")
    np.testing.assert_allclose(depth_decoded[0], [0, *depth], rtol=2e-3)


def rvl(pixels: list[int], width: int, height: int) -> bytes:
    """The code written down nibble by nibble, as the paper has it."""
    nibbles: list[int] = []

    def number(value: int) -> None:
        while True:
            low = value & 7
            value = value >> 3
            nibbles.append(low | (8 if value else 0))
            if not value:
                return

    start, previous = 0, 0
    while start < len(pixels):
        zeros = next((k for k, p in enumerate(pixels[start:]) if p), len(pixels) - start)
        start += zeros
        run = next((k for k, p in enumerate(pixels[start:]) if not p), len(pixels) - start)
        number(zeros)
        number(run)
        for p in pixels[start : start + run]:
            delta = p - previous
            previous = p
            number(2 * delta if delta >= 0 else -2 * delta - 1)
        start += run
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        sum(n << (28 - 4 * k) for k, n in enumerate(nibbles[i : i + 8]))
        for i in range(0, len(nibbles), 8)
    ]
    return struct.pack("<II", width, height) + struct.pack(f"<{len(words)}I", *words)


@given(st.integers(1, 9), st.integers(1, 9), st.data())
def test_rvl_round_trip(width: int, height: int, data: st.DataObject) -> None:
    value = st.one_of(st.just(0), st.integers(1, 65535))
    pixels = data.draw(st.lists(value, min_size=width * height, max_size=width * height))
    assert decode_rvl(rvl(pixels, width, height)).reshape(-1).tolist() == pixels


def test_compressed_depth_without_its_head() -> None:
    raw = np.array([[0, 1000, 2500]], np.uint16)
    for format_ in ("16UC1; compressedDepth", "16UC1; compressedDepth rvl"):
        np.testing.assert_allclose(decode_compressed_depth(png(raw), format_), [[0, 1.0, 2.5]])
    # PNG behind the head, although the format has it otherwise
    depth = decode_compressed_depth(bytes(12) + png(raw), "16UC1; compressedDepth rvl")
    np.testing.assert_allclose(depth, [[0, 1.0, 2.5]])
    with pytest.raises(UndecodableError, match="lacks the parameters"):
        decode_compressed_depth(png(raw), "32FC1; compressedDepth")


def test_rvl_inside_compressed_depth() -> None:
    data = struct.pack("<iff", 1, 0, 0) + rvl([0, 0, 1200, 1300, 0, 7], 3, 2)
    np.testing.assert_allclose(
        decode_compressed_depth(data, "16UC1; compressedDepth rvl"), [[0, 0, 1.2], [1.3, 0, 0.007]]
    )


@given(st.binary(max_size=60))
def test_damaged_rvl_is_refused_or_decoded(data: bytes) -> None:
    with contextlib.suppress(UndecodableError):
        assert decode_rvl(struct.pack("<II", 7, 5) + data).shape == (5, 7)


@pytest.mark.parametrize(
    ("topic", "encoding", "expected"),
    [
        ("/a", "32FC1", True),
        ("/a", "16UC1", True),
        ("/camera/segmentation", "16UC1", False),
        ("/depth_mask", "16UC1", True),
        ("/a", "mono16", False),
        ("/camera/depth/image", "mono16", True),
        ("/camera/depth/image", "mono8", False),
    ],
)
def test_which_pictures_are_depth(topic: str, encoding: str, expected: bool) -> None:
    assert is_depth(topic, encoding) is expected


@pytest.mark.parametrize("is_big", [False, True])
def test_a_wrong_flag_for_the_order_of_bytes_is_seen_from_neighbouring_pixels(is_big: bool) -> None:
    """A wall at a slant, 1 to 3 m away, with the steps of a depth camera and holes."""
    x, y = np.meshgrid(np.arange(80), np.arange(60))
    depth = (1000 + 25 * x + 3 * (y // 7)).astype(np.uint16)
    depth[::9, ::11] = 0
    data = depth.astype(">u2" if is_big else "<u2").tobytes()
    for flag in (False, True):
        np.testing.assert_array_equal(decode_raw(data, Layout(80, 60, 160, "16UC1", flag)), depth)


@pytest.mark.parametrize("is_big", [False, True])
def test_depths_of_which_most_are_the_same_show_the_order_of_bytes_too(is_big: bool) -> None:
    depth = np.repeat(1500 + 7 * np.arange(20), 4)[None].repeat(60, 0).astype(np.uint16)
    data = depth.astype(">u2" if is_big else "<u2").tobytes()
    for flag in (False, True):
        pixels = decode_raw(data, Layout(80, 60, 160, "16UC1", flag), of_depth=True)
        np.testing.assert_array_equal(pixels, depth)


def test_labels_in_steps_of_256_keep_their_order_of_bytes() -> None:
    labels = np.repeat(256 * np.arange(1, 21), 4)[None].repeat(60, 0).astype(np.uint16)
    pixels = decode_raw(labels.astype("<u2").tobytes(), Layout(80, 60, 160, "mono16", False))
    np.testing.assert_array_equal(pixels, labels)


@pytest.mark.parametrize(("encoding", "times"), [("mono8", 4), ("16UC1", 2)])
def test_rows_many_times_as_long_as_their_pixels_are_refused(encoding: str, times: int) -> None:
    with pytest.raises(UndecodableError, match=f"its rows of 32 bytes are {times} times as long"):
        decode_raw(bytes(320), Layout(8, 10, 32, encoding, big_endian=False), of_depth=True)
    padded = decode_raw(bytes(200), Layout(8, 10, 20, "16UC1", big_endian=False), of_depth=True)
    assert padded.shape == (10, 8)


def test_a_picture_may_be_the_left_half_of_a_wider_one() -> None:
    wide = np.arange(160, dtype=np.uint8).reshape(10, 16)
    left = decode_raw(wide.tobytes(), Layout(8, 10, 16, "mono8", big_endian=False))
    np.testing.assert_array_equal(left, wide[:, :8])


def test_a_noisy_picture_keeps_the_order_that_it_names() -> None:
    noise = np.random.default_rng(1).integers(0, 1 << 16, (60, 80)).astype(np.uint16)
    for order, flag in (("<u2", False), (">u2", True)):
        data = noise.astype(order).tobytes()
        np.testing.assert_array_equal(decode_raw(data, Layout(80, 60, 160, "mono16", flag)), noise)

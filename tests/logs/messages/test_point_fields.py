"""Blocks of bytes to points: layouts, byte orders, dropped points and times."""

import struct
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.logs.messages.definitions import UndecodableError
from semloc_logs.logs.messages.point_fields import Field, Layout, decode_points
from semloc_logs.logs.messages.point_times import offsets_ns, sweep_unit

STAMP = 1_700_000_000_123_456_789
XYZ = [Field("x", 0, "f4"), Field("y", 4, "f4"), Field("z", 8, "f4")]


def test_one_point_by_hand() -> None:
    fields = [*XYZ, Field("label", 12, "u4"), Field("ring", 16, "u2")]
    data = struct.pack("<fffIH", 1.5, -2.0, 3.25, 0xFFFF0028, 63)
    p = decode_points(data, Layout(1, 1, 18, 18), fields, STAMP)
    assert p.points.tolist() == [[1.5, -2.0, 3.25]]
    assert p.points.dtype == np.float32
    assert p.label is not None
    assert p.label.tolist() == [0xFFFF0028]
    assert p.label.dtype == np.uint32
    assert p.ring is not None
    assert p.ring.tolist() == [63]
    assert p.offset_ns is None


@pytest.mark.parametrize(("share", "gone"), [(0.0, 0), (0.2, 200)])
def test_rays_without_a_return_at_the_greatest_range_are_left_out(share: float, gone: int) -> None:
    rng = np.random.default_rng(1)
    xyz = rng.normal(0, 10, (1000, 3))
    xyz *= np.minimum(1.0, 49.0 / np.linalg.norm(xyz, axis=1))[:, None]
    far = rng.random(1000).argsort() < share * 1000
    xyz[far] *= (50.0 / np.linalg.norm(xyz[far], axis=1))[:, None]
    p = decode_points(xyz.astype("<f4").tobytes(), Layout(1000, 1, 12, 12000), XYZ, STAMP)
    assert p.without_return == gone
    assert len(p.points) == 1000 - gone
    assert (np.linalg.norm(p.points, axis=1) < 49.9).all()


def _shell(elevations: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """Points (n, 3) at one distance, around the sensor at these elevations (rad)."""
    azimuth = np.linspace(0, 200.0, len(elevations))
    level = np.cos(elevations)
    directions = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevations)]
    return distance * np.stack(directions, axis=1)


def _in_a_street(shell: NDArray[np.float64]) -> NDArray[np.float32]:
    """800 points at ranges up to 60 m, and a shell (n, 3) behind them."""
    rng = np.random.default_rng(2)
    around = _shell(rng.uniform(-0.4, 0.4, 800), 1.0) * rng.uniform(3, 60, (800, 1))
    return np.concatenate([around, shell]).astype("<f4")


def test_a_few_points_of_one_range_are_surfaces() -> None:
    """A radar counts ranges in coarse steps: 60 of 860 points share one."""
    xyz = _in_a_street(_shell(np.random.default_rng(1).uniform(-0.05, 0.3, 60), 12.0))
    p = decode_points(xyz.tobytes(), Layout(860, 1, 12, 0), XYZ, STAMP)
    assert p.without_return == 0


def test_rays_without_a_return_at_a_range_within_the_sweep_are_left_out() -> None:
    xyz = _in_a_street(_shell(np.random.default_rng(1).uniform(-0.05, 0.3, 200), 12.0))
    p = decode_points(xyz.tobytes(), Layout(1000, 1, 12, 12000), XYZ, STAMP)
    assert p.without_return == 200
    np.testing.assert_array_equal(p.points, xyz[:800])


@pytest.mark.parametrize("turn", [0.0, 0.7])  # rad, of the sensor about y
def test_rings_of_one_range_on_floor_and_ceiling_are_surfaces(turn: float) -> None:
    tilt = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    rings = _shell(np.repeat([-0.26, 0.26], 100), 6.0) @ tilt.T
    p = decode_points(_in_a_street(rings).tobytes(), Layout(1000, 1, 12, 12000), XYZ, STAMP)
    assert p.without_return == 0
    assert len(p.points) == 1000


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        (Field("y", 2, "f4"), "its fields x and y share bytes"),
        (Field("y", 8, "f4"), "its fields y and z share bytes"),
        (Field("x", 0, "f8"), "its fields x and y share bytes"),
        (Field("z", 18, "f4"), "its field z ends at byte 22, but a point has 20 bytes"),
    ],
)
def test_fields_that_contradict_each_other_are_refused(changed: Field, reason: str) -> None:
    fields = {f.name: f for f in [*XYZ, Field("t", 16, "u4"), changed]}
    with pytest.raises(UndecodableError, match=reason):
        decode_points(bytes(200), Layout(10, 1, 20, 200), [*fields.values()], STAMP)


def test_other_fields_may_share_bytes_or_lie_beyond_a_point() -> None:
    fields = [*XYZ, Field("rgb", 12, "f4"), Field("rgba", 12, "u4"), Field("padding", 16, "f8")]
    data = struct.pack("<ffff", 1.0, 2.0, 3.0, 0.0)
    p = decode_points(data, Layout(1, 1, 16, 16), fields, STAMP)
    assert p.points.tolist() == [[1.0, 2.0, 3.0]]


def test_a_wall_in_front_is_not_taken_for_rays_without_a_return() -> None:
    y, z = np.meshgrid(np.linspace(-20, 20, 60), np.linspace(-5, 5, 20))
    wall = np.c_[np.full(y.size, 50.0), y.ravel(), z.ravel()].astype("<f4")
    p = decode_points(wall.tobytes(), Layout(len(wall), 1, 12, 12 * len(wall)), XYZ, STAMP)
    assert p.without_return == 0


def test_big_endian_float64() -> None:
    fields = [
        Field("z", 16, "f8"),
        Field("y", 8, "f8"),
        Field("x", 0, "f8"),
        Field("semantic", 24, "u2"),
    ]
    data = struct.pack(">dddH", 1.0, 2.0, 3.0, 258)
    p = decode_points(data, Layout(1, 1, 26, 26, big_endian=True), fields, STAMP)
    assert p.points.tolist() == [[1.0, 2.0, 3.0]]
    assert p.label is not None
    assert p.label.tolist() == [258]


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("is_big", [False, True])
def test_a_wrong_flag_for_the_order_of_bytes_is_seen_from_the_coordinates(
    kind: str, is_big: bool
) -> None:
    size = np.dtype(kind).itemsize
    points = np.random.default_rng(1).uniform(-60, 60, (500, 3))
    points[::7] = 0.0
    points[3] = np.nan
    data = points.astype((">" if is_big else "<") + kind).tobytes()
    fields = [Field(axis, k * size, kind) for k, axis in enumerate("xyz")]
    right = decode_points(data, Layout(500, 1, 3 * size, 0, big_endian=is_big), fields, STAMP)
    wrong = decode_points(data, Layout(500, 1, 3 * size, 0, big_endian=not is_big), fields, STAMP)
    assert 400 < len(right.points) < 500
    np.testing.assert_array_equal(wrong.points, right.points)
    assert wrong.not_finite == right.not_finite == 1


def test_rows_with_padding_and_points_that_are_none() -> None:
    nan = float("nan")
    inf = float("inf")
    first = struct.pack("<ffffff", 1, 2, 3, nan, 0, 0) + b"padding!"
    second = struct.pack("<ffffff", 0, 0, 0, 0, 0, 4)
    p = decode_points(first + second, Layout(2, 2, 12, 32), XYZ, STAMP)
    assert p.points.tolist() == [[1, 2, 3], [0, 0, 4]]
    infinite = struct.pack("<fff", 1, -inf, 3)
    assert len(decode_points(infinite, Layout(1, 1, 12, 12), XYZ, STAMP).points) == 0


@pytest.mark.parametrize(
    "layout",
    [
        Layout(200, 1, 12, 4800),  # half of the points in a row
        Layout(20, 10, 12, 480),  # half of each row
        Layout(40, 5, 12, 480),  # half of the rows
    ],
)
@pytest.mark.parametrize(
    ("behind", "unclaimed"),
    [("points", 200), ("some", 180), ("few", 0), ("zeros", 0), ("nan", 0), ("anything", 0)],
)
def test_points_that_width_and_height_leave_out_are_counted(
    layout: Layout, behind: str, unclaimed: int
) -> None:
    """400 points are there, 200 are claimed; other bytes in the place of these are padding.

    Rays without a return among them, every tenth, are NaN; with 99 measured points nothing is sure.
    """
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-20.0, 20.0, (400, 3)).astype("<f4")
    place = np.arange(400)
    row = 400 if layout.height == 1 else 40
    is_behind = (place % row >= layout.width) | (place // row >= layout.height)
    if behind == "anything":
        xyz[is_behind] = np.frombuffer(rng.bytes(2400), "<f4").reshape(200, 3)
    elif behind == "some":
        xyz[np.flatnonzero(is_behind)[::10]] = np.nan
    elif behind == "few":
        xyz[np.flatnonzero(is_behind)[99:]] = np.nan
    elif behind != "points":
        xyz[is_behind] = np.nan if behind == "nan" else 0.0
    p = decode_points(xyz.tobytes(), layout, XYZ, STAMP)
    assert len(p.points) == 200
    assert p.unclaimed == unclaimed


def test_padding_of_signalling_nan_gives_no_warning() -> None:
    xyz = np.random.default_rng(3).uniform(-20.0, 20.0, (400, 3)).astype("<f4")
    xyz.view("<u4")[200:] = 0x7F800001
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        p = decode_points(xyz.tobytes(), Layout(200, 1, 12, 4800), XYZ, STAMP)
    assert (len(p.points), p.unclaimed) == (200, 0)


def test_tags_of_a_livox() -> None:
    """Its drivers record them beside the line; a tag of another sensor means something else."""
    tag = Field("tag", 12, "u1")
    data = b"".join(struct.pack("<fffBB", k, 0, 0, k, 7) for k in (1, 2, 3, 4, 16))
    livox = [*XYZ, tag, Field("line", 13, "u1")]
    p = decode_points(data, Layout(5, 1, 14, 70), livox, STAMP)
    assert p.points[:, 0].tolist() == [3, 16]
    assert p.ring is not None
    assert p.ring.tolist() == [7, 7]
    assert p.not_finite == 0
    assert len(decode_points(data, Layout(5, 1, 14, 70), [*XYZ, tag], STAMP).points) == 5


def test_columns_follow_the_points_that_are_kept() -> None:
    fields = [*XYZ, Field("label", 12, "u1")]
    data = b"".join(
        struct.pack("<fffB", x, 0, 0, label) for x, label in ((1, 10), (0, 20), (2, 30))
    )
    p = decode_points(data, Layout(3, 1, 13, 39), fields, STAMP)
    assert p.label is not None
    assert p.points[:, 0].tolist() == [1, 2]
    assert p.label.tolist() == [10, 30]


@pytest.mark.parametrize("layout", [Layout(0, 1, 12, 0), Layout(0, 0, 0, 0), Layout(5, 0, 12, 60)])
def test_empty_clouds(layout: Layout) -> None:
    assert decode_points(b"", layout, XYZ, STAMP).points.shape == (0, 3)


@pytest.mark.parametrize(
    "layout",
    [Layout(3, 1, 12, 36), Layout(2**31, 2**31, 12, 0), Layout(1, 2, 12, 13), Layout(1, 1, 0, 0)],
)
def test_claims_beyond_the_data_are_refused(layout: Layout) -> None:
    with pytest.raises(UndecodableError):
        decode_points(b"\0" * 24, layout, XYZ, STAMP)


def test_row_step_zero_means_dense() -> None:
    data = struct.pack("<6f", 1, 0, 0, 2, 0, 0)
    assert decode_points(data, Layout(2, 1, 12, 0), XYZ, STAMP).points[:, 0].tolist() == [1, 2]
    assert decode_points(data, Layout(1, 2, 12, 0), XYZ, STAMP).points[:, 0].tolist() == [1, 2]


@pytest.mark.parametrize(
    "fields", [XYZ[:2], [*XYZ[:2], Field("z", 9, "f4")], [*XYZ[:2], Field("z", 8, "u4")]]
)
def test_positions_must_be_floating_point_fields_inside_the_point(fields: list[Field]) -> None:
    with pytest.raises(UndecodableError, match="field z"):
        decode_points(b"\0" * 12, Layout(1, 1, 12, 12), fields, STAMP)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        # ns since the stamp
        (np.array([0, 50_000_000, 99_999_999], np.uint32), [0, 50_000_000, 99_999_999]),
        (np.array([0, 50_000, 99_999], np.uint32), [0, 50_000_000, 99_999_000]),  # us
        (np.array([0.0, 0.05, 0.0999], np.float32), [0, 50_000_000, 99_900_000]),  # s
        (np.array([0.0, 50.0, 99.9], np.float32), [0, 50_000_000, 99_900_000]),  # ms
        (np.array([0.0, 5e4, 99900], np.float32), [0, 50_000_000, 99_900_000]),  # us
        # stamped at the end of the sweep
        (np.array([-0.1, -0.05, 0.0]), [-100_000_000, -50_000_000, 0]),
        (np.array([STAMP, STAMP + 7_000_001], np.uint64), [0, 7_000_001]),  # ns since 1970
        (np.array([STAMP - 10_000_000, STAMP], np.int64), [-10_000_000, 0]),
        # us since 1970
        (np.array([STAMP // 1000, STAMP // 1000 + 90_000], np.uint64), [-789, 90_000_000 - 789]),
        (np.array([0, 0], np.uint32), [0, 0]),  # a flash sensor
    ],
)
def test_units_and_origins_of_times(values: NDArray[np.generic], expected: list[int]) -> None:
    offset, _ = offsets_ns(values, STAMP)
    assert offset is not None
    assert offset.dtype == np.int64
    np.testing.assert_allclose(offset, expected, atol=20)


@pytest.mark.parametrize(
    ("count", "last", "unit"),
    [
        (20_000, 100_000_000, 1),  # in 0.1 s
        (20_000, 100_000, 1_000),  # 2e8 points a second, if these were nanoseconds
        (20_000, 100, 1_000_000),  # 2e11
        (100, 100, 1_000_000),  # no fewer tell
        (99, 100, 1),
        (20_000, 0, 1),  # a flash sensor
        (20_000, 1_000, 1),  # 1 ms or 1 s: no sweep
        (500, 60_000, 1),  # 8.3e6 points a second, which are possible
        (700, 60_000, 1_000),  # 1.2e7, which are not
    ],
)
def test_the_unit_of_times_that_should_be_nanoseconds(count: int, last: int, unit: int) -> None:
    assert sweep_unit(np.linspace(0, last, count).astype(np.int64)) == unit


def test_differences_to_the_stamp_may_have_lost_their_sign() -> None:
    offsets = np.arange(-40_000_000, 60_000_000, 1_000_000)
    decoded, is_other = offsets_ns((offsets % 2**32).astype(np.uint32), STAMP)
    assert not is_other
    np.testing.assert_array_equal(decoded, offsets)


def test_absolute_seconds_are_exact_to_their_precision() -> None:
    seconds = STAMP * 1e-9 + np.array([0.0, 0.02, 0.1])
    offset, _ = offsets_ns(seconds, STAMP)
    assert offset is not None
    # a float64 of 1.7e9 s resolves 240 ns
    np.testing.assert_allclose(offset, [0, 20_000_000, 100_000_000], atol=500)


@pytest.mark.parametrize(
    "values", [np.array([5.0, np.nan]), np.array([0.0, 1e300]), np.array([0, 2**63], np.uint64)]
)
def test_times_without_sense_are_left_out(values: NDArray[np.generic]) -> None:
    assert offsets_ns(values, STAMP) == (None, False)


@given(st.lists(st.integers(0, 999_999_999), min_size=2, max_size=20))
def test_relative_and_absolute_nanoseconds_agree(offsets: list[int]) -> None:
    if max(offsets) - min(offsets) < 5_000_000:
        return
    relative, _ = offsets_ns(np.array(offsets, np.uint32), STAMP)
    absolute, _ = offsets_ns(np.array(offsets, np.uint64) + np.uint64(STAMP), STAMP)
    assert relative is not None
    assert absolute is not None
    assert relative.tolist() == absolute.tolist() == offsets


def slow_points(
    data: bytes, layout: Layout, kinds: dict[str, tuple[int, str]]
) -> list[tuple[float, ...]]:
    """The obvious loop."""
    order = ">" if layout.big_endian else "<"
    points = []
    for v in range(layout.height):
        for u in range(layout.width):
            start = v * layout.row_step + u * layout.point_step
            point = tuple(
                struct.unpack_from(order + kinds[a][1], data, start + kinds[a][0])[0] for a in "xyz"
            )
            if all(np.isfinite(np.float32(c)) for c in point) and any(
                np.float32(c) != 0 for c in point
            ):
                points.append(point)
    return points


@given(
    st.data(),
    st.integers(0, 3),
    st.integers(0, 4),
    st.integers(0, 5),
    st.integers(0, 7),
    st.booleans(),
)
def test_agrees_with_the_obvious_loop(
    data: st.DataObject, height: int, width: int, gap: int, padding: int, big: bool
) -> None:
    layout = Layout(width, height, 12 + gap, (12 + gap) * width + padding, big)
    content = data.draw(
        st.binary(min_size=layout.row_step * height, max_size=layout.row_step * height)
    )
    kinds = {"y": (0, "f"), "z": (4, "f"), "x": (8 + gap, "f")}
    fields = [Field(name, offset, "f4") for name, (offset, _) in kinds.items()]
    expected = np.array(slow_points(content, layout, kinds), np.float32).reshape(-1, 3)
    assert decode_points(content, layout, fields, STAMP).points.tolist() == expected.tolist()

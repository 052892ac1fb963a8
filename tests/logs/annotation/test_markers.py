"""Drawings of closures and drives, by hand."""

from __future__ import annotations

import numpy as np

from semloc_logs.logs.annotation.markers import Mark, Shape, closure_markers, overview_markers
from semloc_logs.logs.annotation.scene import Drive

RED = (1.0, 0.0, 0.0, 1.0)
GREEN = (0.0, 1.0, 0.0, 1.0)


def mark(key: int, x: float, other: list[float] | None) -> Mark:
    end = None if other is None else np.array(other)
    color = GREEN if other else RED
    return Mark(5, "odom", key, np.array([x, 0.0, 0.0]), end, 0.5, f"closure {key}", color)


def test_a_closure_is_a_sphere_a_line_and_a_text_above_it() -> None:
    group = closure_markers(mark(7, 1.0, [4.0, 2.0, 0.0]))
    assert (group.name, group.number, group.stamp_ns, group.frame_id) == ("semloc/7", 7, 5, "odom")
    sphere, line, text = group.markers
    assert [m.shape for m in group.markers] == [Shape.SPHERE, Shape.LINE_LIST, Shape.TEXT]
    assert (sphere.size, line.size, text.size) == (0.5, 0.1, 0.5)
    assert sphere.points.tolist() == [[1.0, 0.0, 0.0]]
    assert line.points.tolist() == [[1.0, 0.0, 0.0], [4.0, 2.0, 0.0]]
    assert text.points.tolist() == [[1.0, 0.0, 0.75]]  # one and a half times its size
    assert text.text == "closure 7"
    assert {m.color for m in group.markers} == {GREEN}
    lonely = closure_markers(mark(7, 1.0, None))
    assert [m.shape for m in lonely.markers] == [Shape.SPHERE, Shape.TEXT]


def test_an_overview_has_a_group_for_each_drive_and_one_for_all_closures() -> None:
    way = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    drives = [Drive("a", "odom", way, RED), Drive("b", "semloc/b", way + 1.0, GREEN)]
    marks = [mark(0, 1.0, [4.0, 2.0, 0.0]), mark(1, 3.0, None)]
    *of_drives, closures = overview_markers(drives, marks, 9, "odom", 0.5)
    assert [(g.name, g.number, g.frame_id) for g in of_drives] == [
        ("semloc/drives/a", 0, "odom"),
        ("semloc/drives/b", 1, "semloc/b"),
    ]
    strip, name = of_drives[1].markers
    assert (strip.shape, strip.size, strip.color) == (Shape.LINE_STRIP, 0.1, GREEN)
    assert (name.text, name.size, name.points.tolist()) == ("b", 1.0, [[1.0, 1.0, 2.5]])
    spheres, lines = closures.markers
    assert spheres.points.tolist() == [[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]]
    assert list(spheres.colors) == [GREEN, RED]
    assert lines.points.tolist() == [[1.0, 0.0, 0.0], [4.0, 2.0, 0.0]]
    assert list(lines.colors) == [GREEN, GREEN]  # one a point
    assert not overview_markers([], [], 9, "odom", 0.5)[0].markers

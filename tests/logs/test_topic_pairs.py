"""Topics that belong together by their names."""

from __future__ import annotations

from semloc_logs.logs.topic_pairs import (
    calibrations,
    label_meanings,
    one_transport,
    partners,
    shared,
    stem,
)


def test_transports_are_not_part_of_the_name() -> None:
    assert stem("/a/image/compressedDepth") == "/a/image"
    assert stem("/compressed") == "/compressed"
    topics = ["/a/image/compressed", "/a/image", "/b/image/compressed", "/b/image/theora"]
    assert one_transport(topics) == ["/a/image", "/b/image/compressed"]


def test_shared_path_elements() -> None:
    assert shared("/a/b/image/compressed", "/a/b/info") == 2
    assert shared("/a/image", "/c/image") == 0


def test_the_namespace_counts_before_words() -> None:
    candidates = ["/rear/front_info", "/front/info"]
    assert partners(["/front/image"], candidates, forced=False) == {"/front/image": "/front/info"}
    assert partners(["/x_front"], candidates, forced=False) == {"/x_front": "/front/info"}


def test_unrelated_topics_are_partners_only_alone_or_when_forced() -> None:
    assert partners(["/x"], ["/a/info"], forced=False) == {"/x": "/a/info"}
    assert partners(["/x"], ["/a/info", "/b/info"], forced=False) == {}
    assert partners(["/x"], ["/a/info", "/b/info"], forced=True) == {"/x": "/a/info"}
    assert partners(["/x"], [], forced=True) == {}


def test_a_pair_does_not_share_a_calibration() -> None:
    pair = ("/left/image", "/right/image")
    assert calibrations((), pair, ["/right/info"], forced=False) == {pair[1]: "/right/info"}
    both = ["/left/info", "/right/info"]
    assert calibrations((), pair, both, forced=False) == dict(zip(pair, both, strict=True))


def test_beside_label_images_a_lidar_needs_meanings_of_its_own() -> None:
    meanings = ["/cam/label_info"]
    assert label_meanings((), ["/lidar/points"], meanings, forced=False) == {
        "/lidar/points": "/cam/label_info"
    }
    assert label_meanings(["/cam/labels"], ["/lidar/points"], meanings, forced=False) == {
        "/cam/labels": "/cam/label_info"
    }

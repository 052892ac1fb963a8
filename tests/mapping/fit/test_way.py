"""Pairs of clouds that registration left at a wrong distance along the way."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from semloc_logs.mapping.fit.keyframe_pairs import choose, registered
from semloc_logs.mapping.fit.way import searched


def test_a_pair_at_a_wrong_distance_is_registered_again_and_no_other(
    tmp_path: Path, streets: SimpleNamespace
) -> None:
    clouds, _ = streets.drive(tmp_path)
    right = registered(clouds, choose(clouds, 8))
    measured = right.pairs.measured.copy()
    measured[3, :3, 3] *= 1.6  # wheels that spin
    share = right.share.copy()
    share[3] *= 0.5
    wrong = replace(right, pairs=replace(right.pairs, measured=measured), share=share)
    searched_again = searched(clouds, wrong)
    np.testing.assert_allclose(searched_again.pairs.measured[3], right.pairs.measured[3], atol=0.02)
    others = np.arange(len(right.pairs)) != 3
    np.testing.assert_array_equal(
        searched_again.pairs.measured[others], right.pairs.measured[others]
    )
    np.testing.assert_array_equal(searched_again.given_share, right.given_share)

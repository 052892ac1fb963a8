"""Sessions that were made from one recording: their closures are of sweeps with themselves."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from semloc_logs.mapping.session_map import SessionMap

# so many keyframes, or all of a shorter session, are the same measurements: equal stamps alone may
# come from simulated time, which starts at zero in every session
LEAST_SHARED = 3


def same_recordings(maps: Mapping[str, SessionMap]) -> list[str]:
    """A sentence for each pair of sessions that share measurements.

    Whether by the same file under two names, by a copy in another container, or by a part that both
    have: their keyframes have equal stamps, and points with the same mean.
    """
    spans = sorted(
        (int(session.stamps_ns.min()), int(session.stamps_ns.max()), name)
        for name, session in maps.items()
        if len(session.stamps_ns)
    )
    texts = []
    for number, (_, end_ns, first) in enumerate(spans):
        for start_ns, _, second in spans[number + 1 :]:
            if start_ns > end_ns:
                break
            least = min(LEAST_SHARED, *(len(maps[name].stamps_ns) for name in (first, second)))
            count = _shared(maps[first], maps[second])
            if count >= least:
                names = " and ".join(sorted((first, second)))
                texts.append(
                    f"Sessions {names} are of one recording: {count} of their keyframes are the"
                    " same measurements, and closures between these show nothing; give each"
                    " recording once."
                )
    return sorted(texts)


def _shared(session: SessionMap, other: SessionMap) -> int:
    """How many keyframes of both have one stamp, and points with the same mean."""
    _, own_rows, other_rows = np.intersect1d(
        session.stamps_ns, other.stamps_ns, return_indices=True
    )
    if not len(own_rows):
        return 0
    means = session.view_means()
    other_means = other.view_means()
    if not means or not other_means:
        return 0
    return sum(means[i] == other_means[k] for i, k in zip(own_rows, other_rows, strict=True))

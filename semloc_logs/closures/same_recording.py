"""Sessions that were made from one recording: their closures are of sweeps with themselves."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from itertools import combinations

from semloc_logs.mapping.session_map import SessionMap

# so many keyframes, or all of a shorter session, are the same measurements: equal stamps alone may
# come from simulated time, which starts at zero in every session
LEAST_SHARED = 3


def same_recordings(maps: Mapping[str, SessionMap]) -> list[str]:
    """A sentence for each pair of sessions that share measurements.

    Whether by the same file under two names, by a copy in another container, or by a part that both
    have: their keyframes have equal stamps, and points with the same mean.
    """
    owners: dict[tuple[int, tuple[float, ...]], list[str]] = defaultdict(list)
    for name, session in sorted(maps.items()):
        means = session.view_means()
        for key in zip(session.stamps_ns[: len(means)].tolist(), means, strict=True):
            owners[key].append(name)
    shared = Counter(pair for names in owners.values() for pair in combinations(names, 2))
    return [
        f"Sessions {first} and {second} are of one recording: {count} of their keyframes are the"
        " same measurements, and closures between these show nothing; give each recording once."
        for (first, second), count in sorted(shared.items())
        if first != second
        and count >= min(LEAST_SHARED, len(maps[first].stamps_ns), len(maps[second].stamps_ns))
    ]

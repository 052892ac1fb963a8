"""Sessions that were made from one recording: their closures are of sweeps with themselves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from semloc_logs.mapping.session_map import SessionMap

# so many keyframes, or all of a shorter session, are the same measurements: equal stamps alone may
# come from simulated time, which starts at zero in every session
LEAST_SHARED = 3
MOST_NAMES = 4  # in a sentence


def same_recordings(maps: Mapping[str, SessionMap]) -> list[str]:
    """A sentence for each set of sessions that share measurements.

    Whether by the same file under two names, by a copy in another container, or by a part that both
    have: their keyframes have equal stamps, and points with the same mean.
    """
    spans = sorted(
        (int(session.stamps_ns.min()), int(session.stamps_ns.max()), name)
        for name, session in maps.items()
        if len(session.stamps_ns)
    )
    shared: dict[frozenset[str], int] = {}
    for number, (_, end_ns, first) in enumerate(spans):
        for start_ns, _, second in spans[number + 1 :]:
            if start_ns > end_ns:
                break
            least = min(LEAST_SHARED, *(len(maps[name].stamps_ns) for name in (first, second)))
            count = _shared(maps[first], maps[second])
            if count >= least:
                shared[frozenset((first, second))] = count
    return [
        f"Sessions {_names(names)} are of one recording: {_most(shared, names)} of their keyframes"
        " are the same measurements, and closures between these show nothing; give each recording"
        " once."
        for names in _sets(shared)
    ]


def _sets(pairs: Iterable[frozenset[str]]) -> list[list[str]]:
    """The sessions that hang together by ``pairs``, sorted."""
    sets: list[set[str]] = []
    for pair in pairs:
        joined = [one for one in sets if one & pair]
        sets = [one for one in sets if not one & pair] + [set(pair).union(*joined)]
    return sorted(sorted(one) for one in sets)


def _most(shared: Mapping[frozenset[str], int], names: Sequence[str]) -> int:
    """The most keyframes that two of these sessions share."""
    return max(count for pair, count in shared.items() if pair <= {*names})


def _names(names: Sequence[str]) -> str:
    """All names, or the first ones of many."""
    if len(names) <= MOST_NAMES:
        return f"{', '.join(names[:-1])} and {names[-1]}"
    return f"{', '.join(names[:MOST_NAMES])} and {len(names) - MOST_NAMES} others"


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

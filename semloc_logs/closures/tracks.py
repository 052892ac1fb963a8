"""Sessions that satellites tell apart: these need not be searched in each other.

Fixes are never a reason to accept a closure. They leave out a pair only where the whole of both
sessions was located well.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64
from semloc_logs.logs.poses.navsat import earth_centred
from semloc_logs.mapping.session_map import SessionMap

MOST_SIGMA = 5.0  # m, horizontally, of every fix
MOST_GAP_NS = 2_000_000_000  # of a keyframe to the nearest fix; 60 m on a fast road
APART = 500.0  # m; two sensors that see 80 m, both of those gaps, and fixes that are far off


def sure_track(session: SessionMap) -> F64 | None:
    """Earth-centred positions (n, 3) of the fixes; None where any part of the session lacks them.

    Heights do not count: they are taken as on the ellipsoid.
    """
    fixes = session.fixes
    if fixes is None or not fixes.num_rows:
        return None
    sigma = np.stack([fixes[f"sigma_{axis}"].to_numpy() for axis in ("east", "north")])
    if not (sigma <= MOST_SIGMA).all():  # NaN: the receiver does not know
        return None
    fixes_ns = np.sort(fixes["stamp_ns"].to_numpy())
    after = np.clip(np.searchsorted(fixes_ns, session.stamps_ns), 0, len(fixes_ns) - 1)
    before = np.maximum(after - 1, 0)
    gap_ns = np.minimum(
        np.abs(fixes_ns[after] - session.stamps_ns), np.abs(fixes_ns[before] - session.stamps_ns)
    )
    if gap_ns.max(initial=0) > MOST_GAP_NS:
        return None
    places = zip(fixes["latitude_deg"].to_pylist(), fixes["longitude_deg"].to_pylist(), strict=True)
    return np.array([earth_centred(latitude, longitude, 0.0) for latitude, longitude in places])


def are_apart(a: F64 | None, b: F64 | None) -> bool:
    """Whether two tracks, both of which are sure, come nowhere near each other."""
    if a is None or b is None:
        return False
    nearest, _ = cKDTree(b).query(a, distance_upper_bound=APART)
    return bool(np.isinf(nearest).all())

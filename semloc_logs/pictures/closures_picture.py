"""Pictures of closures: where two sessions meet, one map laid on the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.closures.closure import Closure
from semloc_logs.closures.query import SessionMap
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.tables.table import read_table
from semloc_logs.workspace import Workspace

WIDTH = 1400
# RGB
TARGET_COLOUR = (90, 90, 90)
QUERY_COLOUR = (214, 120, 20)


def draw_closures(
    work: Workspace, closures: Sequence[Closure], maps: Mapping[str, SessionMap]
) -> None:
    """WORK/closures.png: the pair of sessions with most closures, the query's map laid on the
    target's by the best closure.

    Grey: the target's map; orange: the query's; lines: their drives; red: where the closures are.
    Without closures nothing is drawn and an older picture is removed.
    """
    pairs: dict[tuple[str, str], list[Closure]] = {}
    for closure in closures:
        ends = (closure.alignment.query_session, closure.alignment.target_session)
        pairs.setdefault(ends, []).append(closure)
    if not pairs:
        work.picture.unlink(missing_ok=True)
        return
    (query_name, target_name), found = max(pairs.items(), key=lambda p: (len(p[1]), p[0]))
    query = maps[query_name]
    target = maps[target_name]
    best = max(
        found, key=lambda c: (c.decision.probability, c.alignment.features.structure)
    ).alignment
    target_T_query = (
        target.map_T_base[best.target_keyframe]
        @ best.target_T_query
        @ inverse(query.map_T_base[best.query_keyframe])
    )
    a = _points(target)
    b = apply(target_T_query, _points(query))
    tracks = [target.map_T_base[:, :3, 3], apply(target_T_query, query.map_T_base[:, :3, 3])]
    every = np.concatenate([a[:, :2], b[:, :2], *(t[:, :2] for t in tracks)])
    low = np.percentile(every, 0.2, axis=0) - 3
    high = np.percentile(every, 99.8, axis=0) + 3
    scale = WIDTH / float((high - low).max())
    size = np.ceil((high - low) * scale).astype(int)
    image = np.full((size[1] + 70, size[0], 3), 255, np.uint8)

    def pixels(points: NDArray[np.float64]) -> NDArray[np.int64]:
        xy = (points[:, :2] - low) * scale
        return np.stack([xy[:, 0], size[1] - 1 - xy[:, 1]], 1).astype(int)

    radius = max(1, round(0.3 * scale))
    for points, colour in ((a, TARGET_COLOUR), (b, QUERY_COLOUR)):
        p = pixels(points)
        p = p[((p >= 0) & (p < size)).all(1)]
        layer = np.zeros(image.shape[:2], np.uint8)
        layer[p[:, 1], p[:, 0]] = 1
        if radius > 1:
            layer = cv2.dilate(layer, np.ones((radius, radius), np.uint8))
        image[layer > 0] = (0.45 * image[layer > 0] + 0.55 * np.array(colour)).astype(np.uint8)
    for track, colour in zip(tracks, ((0, 0, 0), (200, 80, 0)), strict=True):
        cv2.polylines(
            image, [pixels(track).astype(np.int32).reshape(-1, 1, 2)], False, colour, 2, cv2.LINE_AA
        )
    for c in found:
        p = pixels(tracks[0][[c.alignment.target_keyframe]])[0]
        q = pixels(tracks[1][[c.alignment.query_keyframe]])[0]
        cv2.line(image, tuple(p.tolist()), tuple(q.tolist()), (220, 0, 0), 2, cv2.LINE_AA)
        cv2.circle(image, tuple(q.tolist()), 6, (220, 0, 0), -1, cv2.LINE_AA)
    text = f"{query_name} (orange) on {target_name} (grey): {len(found)} closures"
    cv2.putText(
        image, text, (12, size[1] + 28), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 1, cv2.LINE_AA
    )
    bar = 10.0 if scale * 10 < size[0] / 2 else 1.0
    cv2.line(image, (12, size[1] + 50), (12 + int(bar * scale), size[1] + 50), (0, 0, 0), 3)
    cv2.putText(
        image,
        f"{bar:g} m",
        (20 + int(bar * scale), size[1] + 56),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.6,
        (0, 0, 0),
        1,
        cv2.LINE_AA,
    )
    with replacing_file(work.picture) as temporary:
        temporary.write_bytes(cv2.imencode(".png", image[:, :, ::-1])[1].tobytes())


def _points(session: SessionMap) -> NDArray[np.float64]:
    """Centres (n, 3) of what stands at least a metre above the ground of its tile, in the session's
    map frame.
    """
    parts = []
    v = session.json["voxel_size"]
    for path in sorted(session.folder.voxels.rglob("*.parquet")):
        table = read_table(path, ["ix", "iy", "iz"])
        ijk = np.stack([table[c].to_numpy() for c in ("ix", "iy", "iz")], 1)
        if len(ijk):
            parts.append(ijk[ijk[:, 2] > np.percentile(ijk[:, 2], 20) + 3])
    return (np.concatenate(parts) + 0.5) * v if parts else np.zeros((0, 3))

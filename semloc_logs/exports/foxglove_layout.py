"""A layout for Foxglove and Lichtblick in which an annotated log shows its closures at once."""

from __future__ import annotations

import json
from collections.abc import Collection

import numpy as np

from semloc_logs.logs.annotation.channels import CLOSURES, MAP, MARKERS, POSE, topics_of_targets
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply

CLOUDS = ("lidar", "depth")  # roles of streams that are shown as points
LEAST_DISTANCE = 60.0  # metres of the camera from the map
IMAGES = ("image", "stereo_left")


def foxglove_layout(session: SessionMap, targets: Collection[str]) -> str:
    """JSON of a layout: the drive and its closures in 3D, the messages of closures, a picture.

    ``targets`` are the sessions in which closures place this one.

    A layout that the programs import has the configuration of each panel by its id, and how the
    panels divide the window.
    """
    streams = session.json.get("streams", [])
    places = apply(np.array(session.json["session_T_map"]), session.map_T_base[:, :3, 3])
    middle = (places.min(0) + places.max(0)) / 2
    distance = max(LEAST_DISTANCE, float(abs(places[:, :2] - middle[:2]).max()) * 3)
    frame = str(session.json.get("session_frame") or f"semloc/{session.folder.name}")
    shown = [s["topic"] for s in streams if s.get("role") in CLOUDS]
    topics = {
        MARKERS: {"visible": True},
        MAP: {"visible": True, "pointSize": 2, "colorMode": "rgb", "colorField": "rgb"},
        **{
            topic: {"visible": True, "type": "axis", "axisScale": 2}
            for topic in (POSE, *topics_of_targets(targets).values())
        },
        **{topic: {"visible": True, "pointSize": 3} for topic in shown},
    }
    panels: dict[str, object] = {
        "3D!closures": {
            "followMode": "follow-none",
            "followTf": frame,
            "cameraState": {
                "perspective": True,
                "distance": distance,
                "phi": 35,
                "thetaOffset": 0,
                "targetOffset": middle.tolist(),
                "target": [0, 0, 0],
                "targetOrientation": [0, 0, 0, 1],
                "fovy": 45,
                "near": 0.5,
                "far": 50000,
            },
            "scene": {"transforms": {"showLabel": True, "axisScale": 2}},
            "transforms": {},
            "topics": topics,
            "layers": {"grid": {"layerId": "foxglove.Grid", "visible": True, "frameId": frame}},
            "imageMode": {},
        },
        "RawMessages!closures": {"topicPath": CLOSURES, "expansion": "auto"},
    }
    side: object = "RawMessages!closures"
    images = [s["topic"] for s in streams if s.get("role") in IMAGES]
    if images:
        panels["Image!camera"] = {"imageMode": {"imageTopic": images[0]}}
        side = {
            "first": "Image!camera",
            "second": "RawMessages!closures",
            "direction": "column",
            "splitPercentage": 50,
        }
    content = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "first": "3D!closures",
            "second": side,
            "direction": "row",
            "splitPercentage": 70,
        },
    }
    return json.dumps(content, indent=1, sort_keys=True) + "\n"

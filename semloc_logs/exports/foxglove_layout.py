"""A layout for Foxglove and Lichtblick in which an annotated log shows its closures at once."""

from __future__ import annotations

import json
from collections.abc import Collection

import numpy as np

from semloc_logs.logs.annotation.channels import (
    CLOSURES,
    MAP,
    MARKERS,
    OVERVIEW,
    POSE,
    topics_of_targets,
)
from semloc_logs.logs.topic_pairs import calibrations
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply

CLOUDS = ("lidar", "depth")  # roles of streams that are shown as points
LEAST_EXTENT = 20.0  # m, of half the view
DISTANCE = 3.5  # of the camera, over half the extent of the drive
AXES = 0.08  # size over half the extent
SWEEP = "#00b4ffff"  # colour of range data, which no class of the map has
GRID_CELLS = 20
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
    extent = max(LEAST_EXTENT, float(abs(places[:, :2] - middle[:2]).max()))
    frame = session.frame_id if session.posed else str(session.json["base_frame"])
    shown = [s["topic"] for s in streams if s.get("role") in CLOUDS]
    # a colour mode counts only with a field
    packed = {"colorMode": "rgb", "colorField": "rgb"}
    in_ros = {log["encoding"] for log in session.json["logs"]} <= {"ros1", "ros2"}
    colours = packed if in_ros else {"colorMode": "rgba-fields", "colorField": "red"}
    sweep = {"pointSize": 2, "colorMode": "flat", "flatColor": SWEEP, "colorField": "z"}
    topics = {
        OVERVIEW: {"visible": True},
        MARKERS: {"visible": True},
        MAP: {"visible": True, "pointSize": 2, **colours},
        **{
            topic: {"visible": True, "type": "axis", "axisScale": AXES * extent}
            for topic in (POSE, *topics_of_targets(targets).values())
        },
        **{topic: {"visible": True, **sweep} for topic in shown},
    }
    panels: dict[str, object] = {
        "3D!closures": {
            "followMode": "follow-pose",
            "followTf": frame,
            "cameraState": {
                "perspective": True,
                "distance": DISTANCE * extent,
                "phi": 35,
                "thetaOffset": 0,
                "targetOffset": middle.tolist(),
                "target": [0, 0, 0],
                "targetOrientation": [0, 0, 0, 1],
                "fovy": 45,
                "near": 0.5,
                "far": 50000,
            },
            # lines between frames look like closures; the overview has names of the sessions
            "scene": {
                "transforms": {"showLabel": False, "lineWidth": 0, "axisScale": AXES * extent}
            },
            "transforms": {},
            "topics": topics,
            "layers": {
                "grid": {
                    "layerId": "foxglove.Grid",
                    "visible": True,
                    "frameId": frame,
                    "size": 4 * extent,
                    "divisions": GRID_CELLS,
                    "position": middle.tolist(),
                    "color": "#8080804d",
                }
            },
            "imageMode": {},
        },
        "RawMessages!closures": {"topicPath": CLOSURES},
    }
    side: object = "RawMessages!closures"
    images = [s["topic"] for s in streams if s.get("role") in IMAGES]
    if images:
        infos = [s["topic"] for s in streams if s.get("role") == "camera_info"]
        info_of = calibrations(images, (), infos, forced=False)
        picture = {"imageTopic": images[0]}
        if images[0] in info_of:
            picture["calibrationTopic"] = info_of[images[0]]
        panels["Image!camera"] = {"imageMode": picture}
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

"""Faults that show without a registration, as a session has them."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from semloc_logs.logs.session.session import Session
from semloc_logs.mapping.fit.evident_faults import add_evident_faults
from semloc_logs.mapping.fit.findings import StreamFit

LEFT, RIGHT = "/left/image", "/right/image"


@pytest.mark.parametrize(
    ("leads", "added", "text"),
    [
        ({LEFT: 0.5}, 0.0, f"its stamps are up to 0.50 s later .* logs.time_offset.{LEFT}=-0.50 "),
        (
            {RIGHT: 0.5},
            0.0,
            f"the stamps of {RIGHT} are up to 0.50 s later .* logs.time_offset.{RIGHT}=-0.50 ",
        ),
        # the settings have put 0.2 s more onto them already
        ({RIGHT: 0.5}, 0.2, f"logs.time_offset.{RIGHT}=-0.30 "),
        ({RIGHT: 0.05}, 0.0, ""),  # 0.05 s at 3 to 4 m/s are less than a voxel
        ({}, 0.0, ""),
    ],
)
def test_stamps_of_either_picture_of_a_pair_that_are_later_than_their_recording(
    tmp_path: Path,
    streets: SimpleNamespace,
    leads: dict[str, float],
    added: float,
    text: str,
) -> None:
    clouds, track = streets.drive(tmp_path, streets.straight)
    of_role = {"stereo_left": (LEFT,), "stereo_right": (RIGHT,)}
    session: Any = SimpleNamespace(
        roles=SimpleNamespace(topics=lambda role: of_role[role]),
        track=track,
        base_frame="base_link",
        are_poses_fixes=False,
        is_stuck=lambda topic: False,
        repeats=lambda topic: "",
        base_T_sensors=dict,
        shift_of=lambda topic: 0.0,
        time_offset_of=lambda topic: added,
        lead_of=lambda topic: leads.get(topic, 0.0),
        off_stamp_of=lambda topic: 0.0,
    )
    stream = StreamFit(LEFT)
    add_evident_faults(stream, cast(Session, session), clouds)
    texts = " ".join(finding.text for finding in stream.findings)
    assert bool(texts) == bool(text)
    assert re.search(text, texts)

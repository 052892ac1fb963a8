"""Messages of ROS 2 and of ROS 1."""

from __future__ import annotations

import pytest

from tests.logs.messages.encoded import Ros


@pytest.fixture(params=["cdr", "ros1"])
def ros(request: pytest.FixtureRequest) -> Ros:
    return Ros(request.param)

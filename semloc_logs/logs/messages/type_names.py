"""Names of message types."""

from __future__ import annotations


def ros2_type(name: str) -> str:
    """``sensor_msgs/msg/Image`` for all spellings of a type.

    ``sensor_msgs/Image``, ``sensor_msgs/msg/Image`` and ``sensor_msgs::msg::dds_::Image_``.
    """
    if "::" in name:
        name = "/".join(part.rstrip("_") for part in name.split("::") if part != "dds_")
    package, _, rest = name.partition("/")
    if not rest or "/" in rest:
        return name
    return f"{package}/msg/{rest}"

"""Parsers of messages from the network, by their type."""

from functools import cache
from importlib.util import find_spec
from typing import Any

from imagination import plugins
from tests.robustness.parsers.parser import Examples, Parse, Parser

PARSERS: list[Parser] = []

if find_spec("rosbags") is not None:  # an optional extra
    plugins.activate()
    from imagination_ros.codec import Codec

    from tests.robot import ROS2, Messages, spoken
    from tests.robustness.parsers.recordings import CAMERA, frames, images

    @cache
    def codec() -> Codec:
        return Codec("ros2_humble", 10**8)

    def heard() -> list[tuple[str, Any]]:
        """Messages of each type that the node listens to."""
        messages, frame = Messages(ROS2), frames()[0]
        told = [
            each for odometry in (False, True) for each in spoken(frame, CAMERA, messages, True, odometry)
        ]
        picture = messages.compressed(frame.stamp, "camera", "png", images()[0])
        return [*(each[1:] for each in told), ("sensor_msgs/msg/CompressedImage", picture)]

    def decoded(kind: str) -> tuple[Parse, Examples]:
        """What decodes a message of a type, and messages."""
        return (
            lambda path: codec().decode(path.read_bytes(), kind),
            lambda: [codec().encode(message, of) for of, message in heard() if of == kind],
        )

    PARSERS += [Parser(f"cdr-{kind.rpartition('/')[2]}", *decoded(kind)) for kind in dict(heard())]

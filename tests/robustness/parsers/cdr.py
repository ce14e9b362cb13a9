"""Parsers of ROS messages from the network, by type."""

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from imagination.config.plugin_registry import activate
from tests.robustness.parsers.parser import Examples, Parse, Parser

PARSERS: list[Parser] = []

if find_spec("rosbags") is not None:  # an optional extra
    activate()
    from imagination_ros.codec import Codec

    from imagination.recordings.images import COMPRESSED_DEPTH_HEADER
    from imagination.recordings.ros_messages import COMPRESSED, IMAGE, colour_of, depth_of
    from tests.helpers.robot import ROS2, Messages, robot_messages
    from tests.robustness.parsers.recordings import CAMERA, depths, frames, images

    @cache
    def codec() -> Codec:
        return Codec("ros2_humble", 10**8)

    def received_messages() -> list[tuple[str, Any]]:
        """Return messages of each type to which the node subscribes, with their types."""
        messages, frame = Messages(ROS2), frames()[0]
        published = [
            message
            for odometry in (False, True)
            for message in robot_messages(frame, CAMERA, messages, True, odometry)
        ]
        picture = messages.compressed(frame.stamp, "camera", "png", images()[0])
        return [*(message[1:] for message in published), ("sensor_msgs/msg/CompressedImage", picture)]

    def decoded(kind: str) -> tuple[Parse, Examples]:
        """Return a decoder of a message type, and example messages."""
        return (
            lambda path: codec().decode(path.read_bytes(), kind),
            lambda: [
                codec().encode(message, type_) for type_, message in received_messages() if type_ == kind
            ],
        )

    def image_of(kind: str, read: Callable[[Any], object]) -> Callable[[Path], object]:
        """Return a decoder of a message and its image."""
        return lambda path: read(codec().decode(path.read_bytes(), kind))

    def raw_images(*encodings: str) -> list[bytes]:
        """Return messages of uncompressed images."""
        return [
            codec().encode(message, IMAGE)
            for kind, message in received_messages()
            if kind == IMAGE and message.encoding in encodings
        ]

    def compressed(format: str, contents: list[bytes], header: bytes = b"") -> list[bytes]:
        """Return messages of compressed images."""
        messages, stamp = Messages(ROS2), frames()[0].stamp
        encoded = [messages.compressed(stamp, "camera", format, header + content) for content in contents]
        return [codec().encode(message, COMPRESSED) for message in encoded]

    def compressed_depths() -> list[bytes]:
        """Return messages of compressed depth, with the header of compressed_depth_image_transport and without."""
        header = COMPRESSED_DEPTH_HEADER.pack(0, 1000.0, 0.5)
        kinds = [f"{kind}; compressedDepth png" for kind in ("16UC1", "32FC1")]
        return [
            *compressed("png", depths()),
            *(message for kind in kinds for message in compressed(kind, depths(), header)),
        ]

    PARSERS += [
        Parser("ros-colour", image_of(IMAGE, colour_of), lambda: raw_images("rgb8", "bgr8")),
        Parser("ros-depth", image_of(IMAGE, depth_of), lambda: raw_images("16UC1", "32FC1")),
        Parser("ros-compressed-colour", image_of(COMPRESSED, colour_of), lambda: compressed("png", images())),
        Parser("ros-compressed-depth", image_of(COMPRESSED, depth_of), compressed_depths),
    ]
    PARSERS += [
        Parser(f"cdr-{kind.rpartition('/')[2]}", *decoded(kind)) for kind in dict(received_messages())
    ]

"""Server that connects the mapping node to a transport: subscriptions, publications and shutdown."""

import logging
import signal
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from imagination.recordings.ros_messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    ODOMETRY,
    TRANSFORMS,
    is_rectified,
)
from imagination.utils.errors import check_range
from imagination_ros.codec import Codec
from imagination_ros.node import MakeMapper, MappingNode

log = logging.getLogger(__name__)


class Transport(Protocol):
    """Carries messages between the mapping node and other nodes.

    Attributes:
        codec: codec of the messages.
    """

    codec: Codec

    def open(self) -> None:
        """Connect.

        Raises:
            UserError: if a package is not installed, or the transport cannot listen or connect.
        """

    def subscribe(self, topic: str, kind: str, latched: bool, receive: Callable[[Any], None]) -> None:
        """Call `receive` with each decoded message, including past ones if `latched`.

        `receive` may be called from any thread and raises no errors. A message that cannot be decoded is passed as a
        UserError.
        """

    def publish(self, topic: str, kind: str, message: Any) -> None:
        """Send a message on a latched topic (transient local)."""

    def close(self) -> None:
        """Disconnect."""


class RosServer:
    """Maps a robot's messages of a transport; see `MappingNode` for the other arguments.

    Args:
        transport: transport of the messages.
        topics: names of colour, depth, colour_info, depth_info, and odometry (None: /tf).
        compressed: whether `colour` and `depth` are CompressedImage.
        rectified: whether images are rectified; see `is_rectified`.
        publish: namespace of the published topics.

    Raises:
        UserError: if a value is out of range.
    """

    def __init__(
        self,
        transport: Transport,
        topics: Mapping[str, str | None],
        compressed: Mapping[str, bool],
        rectified: bool | None,
        publish: str,
        period: float,
        world: str,
        mount: Mapping[str, Any] | None,
        depth_scale: float,
        max_difference: float,
        max_gap: float,
        patience: float,
    ) -> None:
        check_range("server.period", period, 0.01, 3600.0, "s")
        check_range("server.patience", patience, 0.0, 60.0, "s")
        check_range("server.max_difference", max_difference, 0.0, 10.0, "s")
        check_range("server.max_gap", max_gap, 0.0, 60.0, "s")
        check_range("server.depth_scale", depth_scale, 1.0, 1e6, "units per metre")
        self.transport, self.topics, self.compressed, self.namespace = (
            transport,
            dict(topics),
            dict(compressed),
            publish,
        )
        self.settings: dict[str, Any] = {
            "world": world,
            "mount": mount,
            "depth_scale": depth_scale,
            "max_difference": max_difference,
            "max_gap": max_gap,
            "rectified": {kind: is_rectified(str(topics[kind]), rectified) for kind in ("colour", "depth")},
            "patience": patience,
            "period": period,
        }

    def serve(self, make_mapper: MakeMapper) -> None:
        """Map until Ctrl-C or SIGTERM; see `imagination.serve.Server`."""
        stop = threading.Event()
        received: list[int] = []

        def handle(number: int, frame: Any) -> None:
            received.append(number)
            stop.set()

        handlers = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
        self.transport.open()
        node = MappingNode(make_mapper, self._publish, self.transport.codec, **self.settings)
        try:
            for role, topic, kind in self._subscriptions():

                def receive(message: Any, role: str = role) -> None:
                    node.receive(role, message)

                self.transport.subscribe(topic, kind, role == "tf_static", receive)
            log.info("Listening; press Ctrl-C to stop and save the map")
            while not stop.is_set():
                node.step(timeout=0.1)
            node.publish_pending()
        finally:
            self.transport.close()
            for number, handler in handlers.items():
                signal.signal(number, handler)
            log.info("%s", node.summary())
        if signal.SIGTERM in received:  # the caller ends with the exit code of a terminated process
            signal.raise_signal(signal.SIGTERM)

    def _subscriptions(self) -> list[tuple[str, str, str]]:
        """Return role, topic and message type of each subscription."""
        kinds = {kind: COMPRESSED if self.compressed[kind] else IMAGE for kind in ("colour", "depth")}
        kinds |= {"colour_info": CAMERA_INFO, "depth_info": CAMERA_INFO}
        subscriptions = [(role, str(self.topics[role]), kind) for role, kind in kinds.items()]
        subscriptions.append(("tf_static", "/tf_static", TRANSFORMS))
        if self.topics.get("odometry"):
            subscriptions.append(("odometry", str(self.topics["odometry"]), ODOMETRY))
        else:
            subscriptions.append(("tf", "/tf", TRANSFORMS))
        return subscriptions

    def _publish(self, name: str, kind: str, message: Any) -> None:
        self.transport.publish(f"/{self.namespace.strip('/')}/{name}", kind, message)

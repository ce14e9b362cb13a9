"""ROS 2 messages over Zenoh: a topic's name without its first slash is the key, the payload is CDR.

So zenoh-bridge-ros2dds carries them (eclipse-zenoh/zenoh-plugin-ros2dds); latched topics come with Zenoh's history.
"""

import json
from collections.abc import Callable, Sequence
from typing import Any

from imagination.utils.errors import UserError, check_range, require_extra
from imagination_ros.codec import Codec

HEADROOM = 4
"""Times `max_bytes`: beyond, Zenoh drops what comes over the network unassembled and untold; up to there, we tell."""


class ZenohTransport:
    """A Zenoh session; see `imagination_ros.server.Transport`.

    Args:
        distribution: ROS 2 distribution whose messages are spoken.
        listen, connect: Zenoh endpoints, e.g. tcp/127.0.0.1:7447. Nothing else is looked for.
        max_bytes: of a message.

    Raises:
        UserError: if eclipse-zenoh or rosbags is not installed, or max_bytes is out of range.
    """

    def __init__(
        self, distribution: str, listen: Sequence[str], connect: Sequence[str], max_bytes: int
    ) -> None:
        require_extra("zenoh", "ros")
        import zenoh
        import zenoh.ext

        self._zenoh: Any = zenoh
        most = int(check_range("server.transport.max_bytes", max_bytes, 1, 2**30, "bytes"))
        self.codec = Codec(distribution, most)
        self.listen, self.connect = listen, connect
        self._publishers: dict[str, Any] = {}
        self._subscribers: list[Any] = []

    def open(self) -> None:
        config = self._zenoh.Config()
        settings: dict[str, Any] = {
            "mode": "peer",
            "listen/endpoints": self.listen,
            "connect/endpoints": self.connect,
            "connect/timeout_ms": -1,  # go on trying: the robot may start later
            "connect/exit_on_failure": False,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "timestamping/enabled": True,  # history needs it
            "transport/link/rx/max_message_size": HEADROOM * self.codec.max_bytes,
        }
        try:
            for key, value in settings.items():
                config.insert_json5(key, json.dumps(value))
            self._session = self._zenoh.open(config)
        except self._zenoh.ZError as error:
            raise UserError(
                f"zenoh: cannot listen on {self.listen} and connect to {self.connect} ({error}); choose other lists of "
                "endpoints (server.transport.listen, server.transport.connect), such as [tcp/127.0.0.1:7447]"
            ) from error

    def subscribe(self, topic: str, kind: str, latched: bool, receive: Callable[[Any], None]) -> None:
        def handle(sample: Any) -> None:
            try:
                size = len(sample.payload)  # before it is copied
                if size > self.codec.max_bytes:
                    raise UserError(f"{kind}: got {size} bytes, expected at most {self.codec.max_bytes}")
                message = self.codec.decode(sample.payload.to_bytes(), kind)
            except UserError as error:
                message = error
            receive(message)

        key = topic.strip("/")
        if latched:
            history = self._zenoh.ext.HistoryConfig(detect_late_publishers=True)
            subscriber = self._zenoh.ext.declare_advanced_subscriber(
                self._session, key, handle, history=history
            )
        else:
            subscriber = self._session.declare_subscriber(key, handle)
        self._subscribers.append(subscriber)

    def publish(self, topic: str, kind: str, message: Any) -> None:
        if topic not in self._publishers:
            cache = self._zenoh.ext.CacheConfig(max_samples=1)
            self._publishers[topic] = self._zenoh.ext.declare_advanced_publisher(
                self._session, topic.strip("/"), cache=cache, publisher_detection=True
            )
        self._publishers[topic].put(self.codec.encode(message, kind))

    def close(self) -> None:
        self._session.close()

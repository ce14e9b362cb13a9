"""Transport of ROS 2 messages over Zenoh: the key is the topic name without the leading slash, the payload is CDR.

This is the convention of zenoh-bridge-ros2dds (eclipse-zenoh/zenoh-plugin-ros2dds); latched topics use Zenoh's history.
"""

import json
from collections.abc import Callable, Sequence
from typing import Any

from imagination.utils.errors import UserError, check_range, require_extra
from imagination_ros.codec import Codec

HEADROOM = 4
"""Factor of `max_bytes` beyond which Zenoh drops messages silently; smaller messages are refused with an error."""


class ZenohTransport:
    """Transport over a Zenoh session; see `imagination_ros.server.Transport`.

    Args:
        distribution: ROS 2 distribution of the messages.
        listen, connect: Zenoh endpoints, e.g. tcp/127.0.0.1:7447; scouting is off.
        max_bytes: largest size of a message, bytes.

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
        max_bytes = int(check_range("server.transport.max_bytes", max_bytes, 1, 2**30, "bytes"))
        self.codec = Codec(distribution, max_bytes)
        self.listen, self.connect = listen, connect
        self._publishers: dict[str, Any] = {}
        self._subscribers: list[Any] = []

    def open(self) -> None:
        config = self._zenoh.Config()
        settings: dict[str, Any] = {
            "mode": "peer",
            "listen/endpoints": self.listen,
            "connect/endpoints": self.connect,
            "connect/timeout_ms": -1,  # retry without limit: the robot may start later
            "connect/exit_on_failure": False,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "timestamping/enabled": True,  # needed for history
            "transport/link/rx/max_message_size": HEADROOM * self.codec.max_bytes,
        }
        try:
            for key, value in settings.items():
                config.insert_json5(key, json.dumps(value))
            self._session = self._zenoh.open(config)
        except self._zenoh.ZError as error:
            raise UserError(
                f"zenoh: cannot listen on {self.listen} and connect to {self.connect} ({error}); use other lists of "
                "endpoints (server.transport.listen, server.transport.connect), such as [tcp/127.0.0.1:7447]"
            ) from error

    def subscribe(self, topic: str, kind: str, latched: bool, receive: Callable[[Any], None]) -> None:
        def handle(sample: Any) -> None:
            try:
                size = len(sample.payload)  # checked before the payload is copied
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

"""Mapping node: maps the frames of ROS messages and publishes the map, independent of the transport.

Frames that arrive faster than they are mapped are dropped, except the latest. Invalid messages are refused one by one.
"""

import logging
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.recordings.cameras import mount_of
from imagination.recordings.pose_filters import Jumps
from imagination.recordings.ros_messages import (
    Pairing,
    colour_of,
    depth_of,
    intrinsics_of,
    stamp_of,
    transform_of,
)
from imagination.recordings.tf_tree import Transforms
from imagination.recordings.trajectory import JUMP, SECOND
from imagination.utils.errors import UserError
from imagination_ros.codec import GRID, MARKERS, Codec

log = logging.getLogger(__name__)

MakeMapper = Callable[[RgbdCamera], SemanticMapper]

HISTORY = 30.0
"""History of transforms, seconds."""

MAX_PENDING = 32
"""Largest number of frames that wait for their pose: about one second at common frame rates."""


class Pending(NamedTuple):
    """Pair of images that waits for its pose.

    Attributes:
        stamp: time stamp of the colour image.
        arrived: time of arrival on the monotonic clock, seconds.
        colour, depth: messages of the images.
    """

    stamp: int
    arrived: float
    colour: Any
    depth: Any


class MappingNode:
    """Assembles frames from messages, maps the latest frame and publishes the map.

    Args:
        make_mapper: function that makes the mapper once the camera is known.
        publish: function that sends a message: name in the namespace, type, message.
        codec: codec of the messages.
        world: frame of the map.
        mount: frame of the robot, height (metres), pitch and roll (degrees) of the camera on it; from tf if None.
        depth_scale: units per metre of 16-bit depth.
        max_difference: largest time difference of a colour and a depth image, seconds.
        max_gap: largest gap between two transforms that is interpolated, seconds.
        rectified: whether `colour` and `depth` images are rectified; False for both if None.
        patience: time that an image waits for its pose, seconds.
        period: time between two publications, seconds.

    Raises:
        UserError: if the mount is invalid.

    Attributes:
        counts: number of mapped, dropped and refused frames by reason.
        mapper: semantic mapper; None until the first frame has a pose.
    """

    def __init__(
        self,
        make_mapper: MakeMapper,
        publish: Callable[[str, str, Any], None],
        codec: Codec,
        world: str,
        mount: Mapping[str, Any] | None = None,
        depth_scale: float = 1000.0,
        max_difference: float = 0.02,
        max_gap: float = 0.5,
        rectified: Mapping[str, bool] | None = None,
        patience: float = 1.0,
        period: float = 1.0,
    ) -> None:
        self.make_mapper, self.publish, self.codec = make_mapper, publish, codec
        self.world, self.mount, self.depth_scale = world, mount_of(mount) if mount else None, depth_scale
        self.max_difference = max_difference
        self.rectified = rectified or {"colour": False, "depth": False}
        self.patience, self.period = patience, period
        self.counts: Counter[str] = Counter()
        self.mapper: SemanticMapper | None = None
        self._changed = threading.Condition()  # guards the attributes below
        self._pairing: Pairing[Any] = Pairing(max_difference)
        self._transforms = Transforms(max_gap, HISTORY)
        self._intrinsics: dict[str, tuple[Intrinsics, str]] = {}
        self._pending: deque[Pending] = deque()
        self._jumps = Jumps()
        self._outside = 0
        self._unpublished: int | None = None  # time of the newest mapped frame that was not published
        self._last, self._published = -1, -np.inf

    def receive(self, role: str, message: Any) -> None:
        """Process a message; may be called from any thread.

        Args:
            role: colour, depth, colour_info, depth_info, tf, tf_static or odometry.
            message: decoded message, or the UserError of its decoding.
        """
        with self._changed:
            try:
                if isinstance(message, UserError):
                    raise message
                self._take(role, message)
            except (UserError, AttributeError, TypeError, ValueError) as error:  # fields may hold anything
                self._refuse(role, error)
            self._changed.notify()

    def step(self, timeout: float) -> bool:
        """Wait for a frame with a pose, map the latest one, and return whether a frame was mapped."""
        with self._changed:
            frame = self._next() or (self._changed.wait(timeout) and self._next()) or None
        mapped = frame is not None and self._mapped(*frame)
        if time.monotonic() - self._published >= self.period:
            self.publish_pending()
        return mapped

    def publish_pending(self) -> None:
        """Publish the map if a frame was mapped since the last publication."""
        if (stamp := self._unpublished) is not None:
            self._unpublished = None
            self._try("publication", lambda: self.publish_map(stamp))

    def publish_map(self, stamp: int) -> None:
        """Publish the current map."""
        assert self.mapper is not None, "called after the first mapped frame"
        self._published = time.monotonic()
        maps = self.mapper.maps
        layers = {"occupancy": maps.occupancy_layer()}
        for category, topic in zip(maps.categories, topics_of(maps.categories), strict=True):
            layers[topic] = maps.category_layer(category)
        for name, layer in layers.items():
            self.publish(name, GRID, self.codec.occupancy_grid(layer, maps.grid, maps.frame, stamp))
        colours = dict(zip(maps.categories, self.mapper.spec.colours, strict=True))
        objects = maps.objects()
        self.publish("objects", MARKERS, self.codec.markers(objects, colours, maps.frame, stamp))

    def summary(self) -> str:
        """Summarize the mapped, dropped and refused frames."""
        with self._changed:
            counts = self.counts.copy()
            counts[f"image without a partner within {self.max_difference} s"] += self._pairing.unpaired
            counts["waiting for its pose at the end"] += len(self._pending)
        lines = [f"{counts.pop('mapped', 0)} frames mapped"]
        lines += [f"    {count} x {reason}" for reason, count in counts.most_common() if count]
        if self._outside:
            lines.append(f"    {self._outside} cells outside the map of fixed size are lost")
        return "\n".join(lines)

    def _try(self, step: str, function: Callable[[], None]) -> bool:
        """Run one step of a frame and return whether it succeeded; errors are counted and logged."""
        try:
            function()
        except Exception as error:  # e.g. of OpenCV or the network: one frame must not end the service
            with self._changed:
                self._refuse(step, error)
            return False
        return True

    def _mapped(self, pending: Pending, pose: np.ndarray) -> bool:
        if not self._try("jump of the pose", lambda: self._jumps.check(pending.stamp, pose)):
            return False
        if not self._try("frame", lambda: self._map(pending, pose)):
            return False
        with self._changed:
            self.counts["mapped"] += 1
        self._unpublished = pending.stamp
        return True

    def _map(self, pending: Pending, pose: np.ndarray) -> None:
        if self.mapper is None:
            self.mapper = self.make_mapper(self._camera())
        rgb, depth = colour_of(pending.colour), depth_of(pending.depth, self.depth_scale)
        outside = self.mapper.update(rgb, depth, pose).outside
        if outside and not self._outside:
            log.warning(
                "Cells outside the map of fixed size are lost; enlarge or move the map (extent, centre)"
            )
        self._outside += outside

    def _take(self, role: str, message: Any) -> None:
        if role in ("tf", "tf_static"):
            for entry in message.transforms:
                self._take_transform(role, entry, entry.transform)
        elif role == "odometry":
            self._take_transform(role, message, message.pose.pose)
        elif role.endswith("_info"):
            kind = role.removesuffix("_info")
            self._intrinsics[kind] = intrinsics_of(message, self.rectified[kind]), message.header.frame_id
        else:
            for stamp, colour, depth in self._pairing.add(role, stamp_of(message), message):
                self._pending.append(Pending(stamp, time.monotonic(), colour, depth))
                if len(self._pending) > MAX_PENDING:
                    del self._pending[1]  # not the oldest, whose pose arrives first
                    self.counts["dropped: a later frame came"] += 1

    def _take_transform(self, role: str, entry: Any, transform: Any) -> None:
        """One of several, of which each is refused alone."""
        try:
            names = entry.header.frame_id, entry.child_frame_id
            self._transforms.add(*names, stamp_of(entry), transform_of(transform), fixed=role == "tf_static")
        except (UserError, AttributeError, TypeError, ValueError) as error:
            self._refuse(role, error)

    def _next(self) -> tuple[Pending, np.ndarray] | None:
        """Return the latest frame that has a pose and drop the earlier ones; later frames keep waiting for theirs."""
        while self._pending and time.monotonic() - self._pending[0].arrived > self.patience:
            pose = self._pose(self._pending[0].stamp)
            if not isinstance(pose, str):
                break
            self._pending.popleft()
            self._skip(pose, pose)
        for index in range(len(self._pending) - 1, -1, -1):
            pending = self._pending[index]
            pose = self._pose(pending.stamp)
            if isinstance(pose, str):
                continue
            for _ in range(index + 1):
                self._pending.popleft()
            if index:
                self.counts["dropped for a later frame"] += index
            if self._last - JUMP * SECOND <= pending.stamp <= self._last:
                self.counts["time stamp repeated or out of order"] += 1
                return None
            if pending.stamp < self._last:  # a bag was restarted or a simulation was reset
                log.warning(
                    "The clock went back by %.1f s; mapping continues", (self._last - pending.stamp) / SECOND
                )
                self.counts["jump back of the clock"] += 1
            self._last = pending.stamp
            return pending, pose
        return None

    def _pose(self, stamp: int) -> np.ndarray | str:
        """Return the pose of the colour camera in the world, or the reason why it is unknown."""
        for kind in ("colour", "depth"):
            if kind not in self._intrinsics:
                return f"no camera_info of {kind}"
        frame, mount = self._intrinsics["colour"][1].lstrip("/"), np.eye(4)
        if self.mount is not None and self.mount[0].lstrip("/") not in self._transforms.ancestors(frame)[1:]:
            frame, mount = self.mount  # tf does not contain the position on the robot
        if self.world.lstrip("/") not in self._transforms.ancestors(frame):
            return f"no transforms from {frame!r} to {self.world!r}"
        pose = self._transforms.at(self.world, frame, stamp)
        return "no pose at its time" if pose is None else pose @ mount

    def _camera(self) -> RgbdCamera:
        with self._changed:
            (colour, frame), (depth, depth_frame) = self._intrinsics["colour"], self._intrinsics["depth"]
            depth_to_colour = (
                self._transforms.between(depth_frame, frame) if depth_frame != frame else np.eye(4)
            )
        return RgbdCamera(colour, depth if depth != colour else None, depth_to_colour)

    def _refuse(self, role: str, error: Exception) -> None:
        self._skip(f"refused: {role}", f"{role}: {error or repr(error)}")

    def _skip(self, reason: str, message: str) -> None:
        self.counts[reason] += 1
        if self.counts[reason] == 1:
            log.warning("%s (logged once, counted from now on)", message)


def topics_of(categories: Sequence[str]) -> list[str]:
    """Return a valid ROS name for each category: no dash, no leading digit, no repeated underscore."""
    topics: list[str] = []
    for category in categories:
        topic = re.sub("[-_]+", "_", category if category[0].isalpha() else f"category_{category}")
        while topic in topics:
            topic += "2"
        topics.append(topic)
    return topics

"""The mapping node: messages in, maps out. It knows no transport: what brings and carries messages is given to it.

Frames that come faster than they are mapped are dropped, the latest wins. Bad messages are refused one by one.
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
"""Seconds of transforms that are kept."""

MAX_PENDING = 32
"""Frames that wait for their pose: those of a second at the usual rates."""


class Pending(NamedTuple):
    """A pair of images that waits for its pose.

    Attributes:
        stamp: of the colour image.
        arrived: seconds of a steady clock.
        colour, depth: messages.
    """

    stamp: int
    arrived: float
    colour: Any
    depth: Any


class MappingNode:
    """Collects what belongs to a frame, maps the latest, tells of the map.

    Args:
        make_mapper: makes the mapper once the camera is known.
        publish: sends a message: name in our namespace, type, message.
        codec: makes messages.
        world: frame of the map.
        mount: frame of the robot, height (metres), pitch and roll (degrees) of the camera on it; from tf if None.
        depth_scale: units a metre of 16-bit depth.
        max_difference: seconds between a colour and a depth image.
        max_gap: seconds between two transforms over which none is interpolated.
        max_speed: metres a second at which the camera may move; None: any. See `Jumps`.
        rectified: whether `colour` and `depth` images are; not if None.
        patience: seconds that an image waits for its pose.
        period: seconds between two publications.

    Raises:
        UserError: if the mount is none.

    Attributes:
        counts: frames mapped, dropped and refused, by the reason.
        mapper: None until a frame has a pose.
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
        max_speed: float | None = None,
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
        self._changed = threading.Condition()  # guards all below
        self._pairing: Pairing[Any] = Pairing(max_difference)
        self._transforms = Transforms(max_gap, HISTORY)
        self._intrinsics: dict[str, tuple[Intrinsics, str]] = {}
        self._pending: deque[Pending] = deque()
        self._jumps = Jumps(max_speed)
        self._outside = 0
        self._untold: int | None = None  # time of the newest frame that was mapped and not published
        self._last, self._published = -1, -np.inf

    def receive(self, role: str, message: Any) -> None:
        """Take a message in; of any thread.

        Args:
            role: colour, depth, colour_info, depth_info, tf, tf_static or odometry.
            message: with fields, or the UserError that kept it from being decoded.
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
        """Map the latest frame that has a pose, waiting for one; whether there was one."""
        with self._changed:
            frame = self._next() or (self._changed.wait(timeout) and self._next()) or None
        mapped = frame is not None and self._mapped(*frame)
        if time.monotonic() - self._published >= self.period:
            self.tell_rest()
        return mapped

    def tell_rest(self) -> None:
        """Publish the map if a frame was mapped since it was published."""
        if (stamp := self._untold) is not None:
            self._untold = None
            self._try("publication", lambda: self.tell(stamp))

    def tell(self, stamp: int) -> None:
        """Publish the map as it is."""
        assert self.mapper is not None, "there is a map"
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
        """What was mapped, dropped and refused."""
        with self._changed:
            counts = self.counts.copy()
            counts[f"image without a partner within {self.max_difference} s"] += self._pairing.alone
            counts["waiting for its pose at the end"] += len(self._pending)
        lines = [f"{counts.pop('mapped', 0)} frames mapped"]
        lines += [f"    {count} x {what}" for what, count in counts.most_common() if count]
        if self._outside:
            lines.append(f"    {self._outside} cells outside the map of fixed size are lost")
        return "\n".join(lines)

    def _try(self, what: str, work: Callable[[], None]) -> bool:
        """Do something for one frame; whether it succeeded."""
        try:
            work()
        except (
            Exception
        ) as error:  # OpenCV, onnxruntime, memory, the network: one frame must not end the service
            with self._changed:
                self._refuse(what, error)
            return False
        return True

    def _mapped(self, pending: Pending, pose: np.ndarray) -> bool:
        if not self._try("jump of the pose", lambda: self._jumps.check(pending.stamp, pose)):
            return False
        if not self._try("frame", lambda: self._map(pending, pose)):
            return False
        with self._changed:
            self.counts["mapped"] += 1
        self._untold = pending.stamp
        return True

    def _map(self, pending: Pending, pose: np.ndarray) -> None:
        if self.mapper is None:
            self.mapper = self.make_mapper(self._camera())
        rgb, depth = colour_of(pending.colour), depth_of(pending.depth, self.depth_scale)
        outside = self.mapper.update(rgb, depth, pose).outside
        if outside and not self._outside:
            log.warning(
                "Cells lie outside the map of fixed size and are lost; enlarge or move it (extent, centre)"
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
                    del self._pending[1]  # not the oldest: its pose comes first
                    self.counts["dropped: a later frame came"] += 1

    def _take_transform(self, role: str, entry: Any, transform: Any) -> None:
        """One of several, of which each is refused alone."""
        try:
            names = entry.header.frame_id, entry.child_frame_id
            self._transforms.add(*names, stamp_of(entry), transform_of(transform), fixed=role == "tf_static")
        except (UserError, AttributeError, TypeError, ValueError) as error:
            self._refuse(role, error)

    def _next(self) -> tuple[Pending, np.ndarray] | None:
        """The latest frame that has a pose; those before it are dropped, those after it wait for theirs."""
        while self._pending and time.monotonic() - self._pending[0].arrived > self.patience:
            pose = self._pose(self._pending[0].stamp)
            if not isinstance(pose, str):
                break
            self._pending.popleft()
            self._leave_out(pose, pose)
        for index in range(len(self._pending) - 1, -1, -1):
            pending = self._pending[index]
            pose = self._pose(pending.stamp)
            if isinstance(pose, str):
                continue
            for _ in range(index + 1):
                self._pending.popleft()
            if index:
                self.counts["dropped: a later frame came"] += index
            if self._last - JUMP * SECOND <= pending.stamp <= self._last:
                self.counts["time stamp repeated or out of order"] += 1
                return None
            if pending.stamp < self._last:  # a bag is played again, or a simulation was reset
                log.warning(
                    "The clock went back by %.1f s; mapping goes on", (self._last - pending.stamp) / SECOND
                )
                self.counts["jump back of the clock"] += 1
            self._last = pending.stamp
            return pending, pose
        return None

    def _pose(self, stamp: int) -> np.ndarray | str:
        """Of the colour camera in the world; if something is missing, what."""
        for kind in ("colour", "depth"):
            if kind not in self._intrinsics:
                return f"no camera_info of {kind}"
        frame, mount = self._intrinsics["colour"][1].lstrip("/"), np.eye(4)
        if self.mount is not None and self.mount[0].lstrip("/") not in self._transforms.ancestors(frame)[1:]:
            frame, mount = self.mount  # where tf does not say it
        if self.world.lstrip("/") not in self._transforms.ancestors(frame):
            return f"no transforms from {frame!r} to {self.world!r}"
        pose = self._transforms.at(self.world, frame, stamp)
        return "no pose at its time" if pose is None else pose @ mount

    def _camera(self) -> RgbdCamera:
        with self._changed:
            (colour, frame), (depth, depth_frame) = self._intrinsics["colour"], self._intrinsics["depth"]
            between = self._transforms.between(depth_frame, frame) if depth_frame != frame else np.eye(4)
        return RgbdCamera(colour, depth if depth != colour else None, between)

    def _refuse(self, role: str, error: Exception) -> None:
        self._leave_out(f"refused: {role}", f"{role}: {error or repr(error)}")

    def _leave_out(self, what: str, told: str) -> None:
        self.counts[what] += 1
        if self.counts[what] == 1:
            log.warning("%s (told once, counted from now on)", told)


def topics_of(categories: Sequence[str]) -> list[str]:
    """Names that ROS allows, one for each category: no dash, no digit first, no two underscores in a row."""
    found: list[str] = []
    for category in categories:
        topic = re.sub("[-_]+", "_", category if category[0].isalpha() else f"category_{category}")
        while topic in found:
            topic += "2"
        found.append(topic)
    return found

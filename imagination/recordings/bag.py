"""Recordings in ROS 1 and ROS 2 bags (.bag, .db3, .mcap and folders with metadata.yaml), read with rosbags."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.recordings.cameras import mount_of
from imagination.recordings.recording import BrokenRecordingError, Images, Shot
from imagination.recordings.ros_messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    ODOMETRY,
    OLD_TRANSFORMS,
    TRANSFORMS,
    Pairing,
    colour_of,
    depth_of,
    intrinsics_of,
    is_rectified,
    stamp_of,
    transform_of,
)
from imagination.recordings.tf_tree import Transforms
from imagination.recordings.trajectory import SECOND, Stamp
from imagination.utils.errors import UserError, check_range, require_extra

NO_COLOUR = ("depth", "infra", "/ir/", "disparity", "confidence", "mask", "label")
"""Parts of the names of image topics that are not colour."""

TYPES = {
    "colour": (IMAGE, COMPRESSED),
    "depth": (IMAGE, COMPRESSED),
    "colour_info": (CAMERA_INFO,),
    "depth_info": (CAMERA_INFO,),
    "odometry": (ODOMETRY,),
}
"""Message types of each role's topic."""


class BagRecording:
    """Recording in a ROS bag with colour and depth images, camera_info, and poses from tf or odometry.

    Topics that are not set are found by type and name. The pose of the camera comes from /tf and /tf_static, or from
    /tf_static and odometry if an odometry topic is set or there is no /tf. `mount` is needed if the bag does not
    contain the transform from the camera to the robot.

    Args:
        path: path of the bag.
        topics: names of `colour`, `depth`, `colour_info`, `depth_info` and `odometry`; detected if None.
        world: frame of the map; the root frame of the camera if None.
        mount: frame of the robot, height (metres), pitch and roll (degrees) of the camera on it; from tf if None.
        depth_scale: units per metre of 16-bit depth.
        max_difference: largest time difference of a colour and a depth image, seconds.
        max_gap: largest gap between two transforms that is interpolated, seconds.
        rectified: whether images are rectified; see `is_rectified`.

    Raises:
        UserError: if the bag cannot be opened, or topics or frames are missing or ambiguous; the message lists the
            existing ones.
    """

    def __init__(
        self,
        path: str,
        topics: Mapping[str, str | None],
        world: str | None,
        mount: Mapping[str, Any] | None,
        depth_scale: float,
        max_difference: float,
        max_gap: float,
        rectified: bool | None = None,
    ) -> None:
        self.path = Path(path)
        self.depth_scale = check_range("recording.depth_scale", depth_scale, 1.0, 1e6, "units per metre")
        self.max_difference = check_range("recording.max_difference", max_difference, 0.0, 10.0, "s")
        self.skipped: Counter[str] = Counter()
        self._reader = open_bag(self.path)
        roles = Topics(self._reader.connections, topics)
        self.rectified = rectified
        self.topics = {"colour": roles.colour, "depth": roles.depth}
        self._infos: dict[str, Any] = {}
        self._conflicts: dict[str, UserError] = {}
        self.transforms = Transforms(check_range("recording.max_gap", max_gap, 0.0, 3600.0, "s"))
        self._read_poses(roles)
        for kind in ("colour", "depth"):
            if kind not in self._infos:
                raise UserError(f"{self.path}: topic {roles.infos[kind]!r} has no camera_info message")
        self.frame, self._depth_frame = (
            str(self._infos[kind].header.frame_id).lstrip("/") for kind in ("colour", "depth")
        )
        if mount is not None:
            base, matrix = mount_of(mount)
            root = self.transforms.ancestors(self.frame)[-1]  # drivers publish the frames inside the camera
            root_to_camera = self.transforms.between(root, self.frame)
            self.transforms.add(base, root, 0, matrix @ root_to_camera, fixed=True)
        for child in {*self.transforms.ancestors(self.frame), *self.transforms.ancestors(self._depth_frame)}:
            if child in self._conflicts:
                raise self._conflicts[child]
        self.world: str = (world or self.transforms.ancestors(self.frame)[-1]).lstrip("/")
        if self.world == self.frame and not self.transforms.moving:
            raise UserError(f"{self.path}: got no poses, expected /tf or an odometry topic")
        self.camera = self._camera()
        self.transforms.at(self.world, self.frame, 0)  # raises if `world` is no ancestor of the camera
        if not self._moves():
            raise UserError(
                f"{self.path}: the camera's frame {self.frame!r} does not move in {self.world!r}; its frames are "
                f"{' in '.join(self.transforms.ancestors(self.frame))}; set recording.mount, the camera's position "
                "on the robot"
            )
        if repeated := sum(trajectory.repeated for trajectory in self.transforms.moving):
            self.skipped["repeated transform"] += repeated

    def shots(self) -> Iterator[Shot]:
        """Iterate over the pairs of images in recording order; see `Recording`."""
        pairing: Pairing[Any] = Pairing(self.max_difference)
        kinds = {name: kind for kind, name in self.topics.items()}
        for topic, message in self._messages(self.topics.values()):
            yield from map(self._shot, pairing.add(kinds[topic], stamp_of(message), message))
        yield from map(self._shot, pairing.flush())
        if pairing.unpaired:
            self.skipped["image without a partner at its time"] += pairing.unpaired

    def _shot(self, pair: tuple[Stamp, Any, Any]) -> Shot:
        return Shot(pair[0], self.transforms.at(self.world, self.frame, pair[0]), partial(self._load, *pair))

    def _load(self, stamp: Stamp, colour: Any, depth: Any) -> Images:
        try:
            return Images(colour_of(colour), depth_of(depth, self.depth_scale))
        except BrokenRecordingError as error:
            seconds = (stamp - self._reader.start_time) / SECOND
            raise BrokenRecordingError(f"{self.path}, {seconds:.3f} s after its start: {error}") from error

    def _messages(self, topics: Iterable[str], tolerant: bool = False) -> Iterator[tuple[str, Any]]:
        """Iterate over (topic, message) in recording order; `tolerant` skips messages that cannot be decoded.

        Raises:
            BrokenRecordingError: where the bag is damaged, with the number of messages and the time before it.
        """
        connections = [link for link in self._reader.connections if link.topic in set(topics)]
        count, time = 0, self._reader.start_time
        try:
            for connection, time, data in self._reader.messages(connections):  # noqa: B007 (used in the error)
                try:
                    message = self._reader.deserialize(data, connection.msgtype)
                except Exception:
                    if not tolerant:
                        raise
                    self.skipped[f"undecodable message of {connection.topic}"] += 1
                    continue
                yield connection.topic, message
                count += 1
        except Exception as error:  # the reader raises many types on a damaged file
            seconds = (time - self._reader.start_time) / SECOND
            raise BrokenRecordingError(
                f"{self.path}: damaged after {count} messages of {', '.join(sorted(set(topics)))}, "
                f"{seconds:.3f} s after its start ({error})"
            ) from error

    def _read_poses(self, roles: "Topics") -> None:
        """Read all transforms and the first camera_info of each camera; damage is raised when images are read."""
        kinds = {name: kind for kind, name in roles.infos.items()}
        try:
            for topic, message in self._messages([*roles.poses, *roles.infos.values()], tolerant=True):
                if topic in kinds:
                    for kind, name in roles.infos.items():
                        if name == topic:
                            self._infos.setdefault(kind, message)
                else:
                    self._add_transforms(message, fixed=topic.endswith("tf_static"))
        except BrokenRecordingError as error:
            self.skipped[f"poses: {error}"] += 1

    def _add_transforms(self, message: Any, fixed: bool) -> None:
        if hasattr(message, "transforms"):
            entries = [(each, each.child_frame_id, each.transform) for each in message.transforms]
        else:
            entries = [(message, message.child_frame_id, message.pose.pose)]
        for entry, child, transform in entries:
            try:
                stamp, matrix = stamp_of(entry), transform_of(transform)
            except UserError:
                self.skipped["invalid transform"] += 1
                continue
            try:
                self.transforms.add(entry.header.frame_id, child, stamp, matrix, fixed)
            except UserError as error:  # raised later if the camera depends on this transform
                self.skipped["transform that contradicts earlier ones"] += 1
                self._conflicts.setdefault(child.lstrip("/"), error)

    def _camera(self) -> RgbdCamera:
        colour, depth = (self._intrinsics(kind) for kind in ("colour", "depth"))
        separate = self._depth_frame != self.frame
        depth_to_colour = self.transforms.between(self._depth_frame, self.frame) if separate else np.eye(4)
        return RgbdCamera(colour, depth if depth != colour else None, depth_to_colour)

    def _intrinsics(self, kind: str) -> Intrinsics:
        try:
            return intrinsics_of(self._infos[kind], is_rectified(self.topics[kind], self.rectified))
        except UserError as error:
            raise UserError(f"{self.path}, {kind}: {error}") from error

    def _moves(self) -> bool:
        chain = self.transforms.ancestors(self.frame)
        return self.transforms.moves(chain[: chain.index(self.world)])


class Topics:
    """Topics of a bag by role.

    Args:
        connections: connections of the bag.
        names: topic names set by the user, by role.

    Raises:
        UserError: if a topic is missing or ambiguous; the message lists the existing topics.
    """

    def __init__(self, connections: Iterable[Any], names: Mapping[str, str | None]) -> None:
        self.types = {link.topic: link.msgtype for link in connections}
        if unknown := {name for name in names.values() if name is not None and name not in self.types}:
            raise UserError(
                f"recording.topics: got {', '.join(sorted(unknown))}, expected topics of the bag: {self._listed()}"
            )
        for role, name in names.items():
            if name is not None and self.types[name] not in TYPES[role]:
                raise UserError(
                    f"recording.topics.{role}: got {name} of type {self.types[name]}, expected "
                    f"{' or '.join(TYPES[role])}. Topics of the bag: {self._listed()}"
                )
        images = [name for name, kind in self.types.items() if kind in (IMAGE, COMPRESSED)]
        self.colour = names.get("colour") or self._only(
            "colour", [name for name in images if not any(word in name.lower() for word in NO_COLOUR)]
        )
        self.depth = names.get("depth") or self._only(
            "depth", [name for name in images if "depth" in name.lower()]
        )
        self.infos = {
            kind: names.get(f"{kind}_info") or self._info_of(kind, image)
            for kind, image in (("colour", self.colour), ("depth", self.depth))
        }
        transforms = [name for name, kind in self.types.items() if kind in (TRANSFORMS, OLD_TRANSFORMS)]
        odometry = names.get("odometry")
        if odometry is None and not any(name.strip("/").endswith("tf") for name in transforms):
            odometry = self._only("odometry", [name for name, kind in self.types.items() if kind == ODOMETRY])
        fixed = [name for name in transforms if name.endswith("tf_static")]
        self.poses = [*fixed, odometry] if odometry else transforms

    def _only(self, kind: str, names: list[str]) -> str:
        """Return the only topic of a kind; a compressed copy of a raw image topic is ignored."""
        raw = [name for name in names if not any(name.startswith(f"{other}/") for other in names)]
        if len(raw) != 1:
            raise UserError(
                f"recording.topics.{kind}: got {', '.join(raw) or 'none'}, expected one topic; set it. "
                f"Topics of the bag: {self._listed()}"
            )
        return raw[0]

    def _info_of(self, kind: str, image: str) -> str:
        """Return the camera_info topic in an image's namespace, or one level above for compressed images."""
        parts = image.split("/")
        for depth in (1, 2):
            name = "/".join([*parts[:-depth], "camera_info"])
            if self.types.get(name) == CAMERA_INFO:
                return name
        return self._only(
            f"{kind}_info", [name for name, msgtype in self.types.items() if msgtype == CAMERA_INFO]
        )

    def _listed(self) -> str:
        return ", ".join(f"{name} ({kind})" for name, kind in sorted(self.types.items())) or "nothing"


def open_bag(path: Path) -> Any:
    """Open a bag with rosbags, or a truncated bag with `CutBag`.

    Raises:
        UserError: if rosbags is not installed, or the bag is missing or cannot be opened.
    """
    require_extra("rosbags", "bags")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    from imagination.recordings.cut_bags import CutBag

    if not path.exists():
        raise UserError(f"recording.path: got {path}, but there is no such bag")
    try:
        # bags before 2023 have no message definitions; those of the messages used here are unchanged since
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        return reader
    except Exception as error:  # the reader raises many types on a damaged file
        try:
            return CutBag(path)
        except Exception as other:
            raise UserError(
                f"{path}: cannot be opened as a bag ({error}) and has no readable message at the beginning ({other}); "
                "repair it with `ros2 bag reindex`, `mcap recover` or `rosbag reindex`"
            ) from error

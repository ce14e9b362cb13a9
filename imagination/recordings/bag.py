"""ROS 1 and ROS 2 bags (.bag, .db3, .mcap and folders with metadata.yaml), read by the library rosbags."""

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
"""In the names of image topics that are not colour."""

TYPES = {
    "colour": (IMAGE, COMPRESSED),
    "depth": (IMAGE, COMPRESSED),
    "colour_info": (CAMERA_INFO,),
    "depth_info": (CAMERA_INFO,),
    "odometry": (ODOMETRY,),
}
"""Of the messages that a topic of each role holds."""


class BagRecording:
    """A ROS bag with colour and depth images, camera_info, and poses from tf or odometry.

    Topics that are not given are found by type and name. The camera's pose comes from the transforms of /tf and
    /tf_static, or of /tf_static and odometry where that is given or there is no /tf. Where nothing in the bag says how
    the camera sits on the robot, `mount` does.

    Args:
        path: of the bag.
        topics: names of `colour`, `depth`, `colour_info`, `depth_info` and `odometry`; found if None.
        world: frame of the map; the uppermost that the camera's is in if None.
        mount: frame of the robot, height (metres), pitch and roll (degrees) of the camera on it; from tf if None.
        depth_scale: units a metre of 16-bit depth.
        max_difference: seconds between a colour and a depth image, at most.
        max_gap: seconds between two transforms over which none is interpolated.
        rectified: whether images are; see `is_rectified`.

    Raises:
        UserError: if the bag cannot be opened, or topics or frames are missing or ambiguous, with those that exist.
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
        self.depth_scale = check_range("recording.depth_scale", depth_scale, 1.0, 1e6, "units a metre")
        self.max_difference = check_range("recording.max_difference", max_difference, 0.0, 10.0, "s")
        self.skipped: Counter[str] = Counter()
        self._reader = open_bag(self.path)
        found = Topics(self._reader.connections, topics)
        self.rectified = rectified
        self.topics = {"colour": found.colour, "depth": found.depth}
        self._infos: dict[str, Any] = {}
        self._conflicts: dict[str, UserError] = {}
        self.transforms = Transforms(check_range("recording.max_gap", max_gap, 0.0, 3600.0, "s"))
        self._read_poses(found)
        for kind in ("colour", "depth"):
            if kind not in self._infos:
                raise UserError(f"{self.path}: topic {found.infos[kind]!r} holds no camera_info")
        self.frame, self._depth_frame = (
            str(self._infos[kind].header.frame_id).lstrip("/") for kind in ("colour", "depth")
        )
        if mount is not None:
            base, matrix = mount_of(mount)
            root = self.transforms.ancestors(self.frame)[-1]  # drivers publish the frames within their camera
            within = self.transforms.between(root, self.frame)
            self.transforms.add(base, root, 0, matrix @ within, fixed=True)
        for child in {*self.transforms.ancestors(self.frame), *self.transforms.ancestors(self._depth_frame)}:
            if child in self._conflicts:
                raise self._conflicts[child]
        self.world: str = (world or self.transforms.ancestors(self.frame)[-1]).lstrip("/")
        if self.world == self.frame and not self.transforms.moving:
            raise UserError(f"{self.path}: holds no poses, neither in /tf nor in an odometry topic")
        self.camera = self._camera()
        self.transforms.at(self.world, self.frame, 0)  # refuses a world that the camera is not in
        if not self._moves():
            raise UserError(
                f"{self.path}: the camera's frame {self.frame!r} does not move in {self.world!r}; its frames are "
                f"{' in '.join(self.transforms.ancestors(self.frame))}; recording.mount says where it sits on the robot"
            )
        if repeated := sum(trajectory.repeated for trajectory in self.transforms.moving):
            self.skipped["repeated transform"] += repeated

    def shots(self) -> Iterator[Shot]:
        """Pairs of images as they were recorded; see `Recording`."""
        pairing: Pairing[Any] = Pairing(self.max_difference)
        kinds = {name: kind for kind, name in self.topics.items()}
        for topic, message in self._messages(self.topics.values()):
            yield from map(self._shot, pairing.add(kinds[topic], stamp_of(message), message))
        yield from map(self._shot, pairing.rest())
        if pairing.alone:
            self.skipped["image without a partner at its time"] += pairing.alone

    def _shot(self, pair: tuple[Stamp, Any, Any]) -> Shot:
        return Shot(pair[0], self.transforms.at(self.world, self.frame, pair[0]), partial(self._load, *pair))

    def _load(self, stamp: Stamp, colour: Any, depth: Any) -> Images:
        try:
            return Images(colour_of(colour), depth_of(depth, self.depth_scale))
        except BrokenRecordingError as error:
            seconds = (stamp - self._reader.start_time) / SECOND
            raise BrokenRecordingError(f"{self.path}, {seconds:.3f} s after its start: {error}") from error

    def _messages(self, topics: Iterable[str], tolerant: bool = False) -> Iterator[tuple[str, Any]]:
        """Topic and content of messages, in the order of the recording; `tolerant` skips those that cannot be decoded.

        Raises:
            BrokenRecordingError: where the bag is damaged: after how many messages and how long after its start.
        """
        wanted = [link for link in self._reader.connections if link.topic in set(topics)]
        count, time = 0, self._reader.start_time
        try:
            for connection, time, data in self._reader.messages(wanted):  # noqa: B007 (told in the error)
                try:
                    message = self._reader.deserialize(data, connection.msgtype)
                except Exception:
                    if not tolerant:
                        raise
                    self.skipped[f"message of {connection.topic} that cannot be read"] += 1
                    continue
                yield connection.topic, message
                count += 1
        except Exception as error:  # a damaged file makes its reader raise anything
            seconds = (time - self._reader.start_time) / SECOND
            raise BrokenRecordingError(
                f"{self.path}: damaged after {count} messages of {', '.join(sorted(set(topics)))}, "
                f"{seconds:.3f} s after its start ({error})"
            ) from error

    def _read_poses(self, found: "Topics") -> None:
        """All transforms, and the first camera_info of each camera; damage shows again when images are read."""
        kinds = {name: kind for kind, name in found.infos.items()}
        try:
            for topic, message in self._messages([*found.poses, *found.infos.values()], tolerant=True):
                if topic in kinds:
                    for kind, name in found.infos.items():
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
                self.skipped["transform that is none"] += 1
                continue
            try:
                self.transforms.add(entry.header.frame_id, child, stamp, matrix, fixed)
            except UserError as error:  # of no importance unless the camera hangs on it
                self.skipped["transform at odds with those before"] += 1
                self._conflicts.setdefault(child.lstrip("/"), error)

    def _camera(self) -> RgbdCamera:
        colour, depth = (self._intrinsics(kind) for kind in ("colour", "depth"))
        beside = self._depth_frame != self.frame
        between = self.transforms.between(self._depth_frame, self.frame) if beside else np.eye(4)
        return RgbdCamera(colour, depth if depth != colour else None, between)

    def _intrinsics(self, kind: str) -> Intrinsics:
        try:
            return intrinsics_of(self._infos[kind], is_rectified(self.topics[kind], self.rectified))
        except UserError as error:
            raise UserError(f"{self.path}, {kind}: {error}") from error

    def _moves(self) -> bool:
        chain = self.transforms.ancestors(self.frame)
        return self.transforms.moves(chain[: chain.index(self.world)])


class Topics:
    """Which topics of a bag hold what.

    Args:
        connections: of the bag.
        given: names that the user gave.

    Raises:
        UserError: if one is missing or several could be meant, with those that exist.
    """

    def __init__(self, connections: Iterable[Any], given: Mapping[str, str | None]) -> None:
        self.types = {link.topic: link.msgtype for link in connections}
        if unknown := {name for name in given.values() if name is not None and name not in self.types}:
            raise UserError(
                f"recording.topics: got {', '.join(sorted(unknown))}, expected topics of the bag: {self._listed()}"
            )
        for role, name in given.items():
            if name is not None and self.types[name] not in TYPES[role]:
                raise UserError(
                    f"recording.topics.{role}: got {name}, which holds {self.types[name]}, expected "
                    f"{' or '.join(TYPES[role])}. The bag holds: {self._listed()}"
                )
        images = [name for name, kind in self.types.items() if kind in (IMAGE, COMPRESSED)]
        self.colour = given.get("colour") or self._only(
            "colour", [name for name in images if not any(word in name.lower() for word in NO_COLOUR)]
        )
        self.depth = given.get("depth") or self._only(
            "depth", [name for name in images if "depth" in name.lower()]
        )
        self.infos = {
            kind: given.get(f"{kind}_info") or self._info_beside(kind, image)
            for kind, image in (("colour", self.colour), ("depth", self.depth))
        }
        transforms = [name for name, kind in self.types.items() if kind in (TRANSFORMS, OLD_TRANSFORMS)]
        odometry = given.get("odometry")
        if odometry is None and not any(name.strip("/").endswith("tf") for name in transforms):
            odometry = self._only("odometry", [name for name, kind in self.types.items() if kind == ODOMETRY])
        fixed = [name for name in transforms if name.endswith("tf_static")]
        self.poses = [*fixed, odometry] if odometry else transforms

    def _only(self, kind: str, names: list[str]) -> str:
        """The one topic of a kind; an image and its compressed copy count as one, the raw one."""
        raw = [name for name in names if not any(name.startswith(f"{other}/") for other in names)]
        if len(raw) != 1:
            raise UserError(
                f"recording.topics.{kind}: found {', '.join(raw) or 'none'}, expected one; set it. "
                f"The bag holds: {self._listed()}"
            )
        return raw[0]

    def _info_beside(self, kind: str, image: str) -> str:
        """camera_info in the same namespace, or one level above for compressed images."""
        parts = image.split("/")
        for depth in (1, 2):
            name = "/".join([*parts[:-depth], "camera_info"])
            if self.types.get(name) == CAMERA_INFO:
                return name
        return self._only(f"{kind}_info", [name for name, of in self.types.items() if of == CAMERA_INFO])

    def _listed(self) -> str:
        return ", ".join(f"{name} ({kind})" for name, kind in sorted(self.types.items())) or "nothing"


def open_bag(path: Path) -> Any:
    """Open a bag with rosbags, or, if its end is lost, what there is of it.

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
        # bags of before 2023 hold no definitions; those of the messages read here have not changed since
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        return reader
    except Exception as error:  # a damaged file makes its reader raise anything
        try:
            return CutBag(path)
        except Exception as other:
            raise UserError(
                f"{path}: cannot be opened as a bag ({error}), and holds no message at its beginning ({other}); "
                "repair it with `ros2 bag reindex`, `mcap recover` or `rosbag reindex`"
            ) from error

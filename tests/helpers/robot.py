"""Simulated robot that drives through a scene and records TUM folders, plain folders and bags."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose
from imagination.geometry.rgbd import Intrinsics
from imagination.scenes.renderer import Renderer
from imagination.scenes.scene import FreeSpace, Scene

TICK = 100_000_000
"""Nanoseconds between two frames."""

BEGIN = 1_700_000_000_123_456_789
"""Start of the recording, nanoseconds."""

TUM_SCALE = 5000

ROS2, ROS1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))


class RecordedFrame(NamedTuple):
    """Frame of the robot; depth in multiples of 1/5000 m, which every format represents exactly as float32."""

    stamp: int
    pose: Pose
    rgb: np.ndarray
    depth: np.ndarray


def corridor_path(free: FreeSpace, steps: int) -> list[Pose]:
    """Return the path between the two free cells with the largest walking distance, away from walls."""
    cells = np.argwhere(free.mask)[::1]
    index = np.full(free.mask.shape, -1)
    index[tuple(cells.T)] = np.arange(len(cells))
    clearance = distance_transform_edt(np.pad(free.mask, 1))[1:-1, 1:-1]
    links = []
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        other = cells + [dr, dc]
        inside = ((other >= 0) & (other < free.mask.shape)).all(axis=1)
        a, b = cells[inside], other[inside]
        free_pairs = index[tuple(b.T)] >= 0
        a, b = a[free_pairs], b[free_pairs]
        cost = np.hypot(dr, dc) * (1 + 4 / np.minimum(clearance[tuple(a.T)], clearance[tuple(b.T)]))
        links.append((index[tuple(a.T)], index[tuple(b.T)], cost))
    start, end, cost = (np.concatenate(column) for column in zip(*links, strict=True))
    graph = coo_array((cost, (start, end)), shape=(len(cells), len(cells))).tocsr()

    def farthest(one: int) -> tuple[int, np.ndarray]:
        distance, before = dijkstra(graph, directed=False, indices=one, return_predecessors=True)
        return int(np.argmax(np.where(np.isfinite(distance), distance, -1))), before

    first, _ = farthest(0)
    last, before = farthest(first)
    way = [last]
    while way[-1] != first:
        way.append(int(before[way[-1]]))
    points = free.grid.to_points(cells[way])
    selected = points[np.linspace(0, len(points) - 1, steps).astype(int)]
    ahead = np.diff(selected, axis=0, append=2 * selected[-1:] - selected[-2:-1])
    return [
        Pose(float(x), float(y), float(np.arctan2(b, a)))
        for (x, y), (a, b) in zip(selected, ahead, strict=True)
    ]


def drive(scene: Scene, camera: Camera, poses: Sequence[Pose]) -> Iterator[RecordedFrame]:
    """Render the frames along a path."""
    renderer = Renderer(scene.mesh, scene.lighting)
    for number, pose in enumerate(poses):
        image = renderer.render(camera, camera.to_world(pose, scene.floor_height))
        depth = np.rint(image.depth * TUM_SCALE).clip(0, 65535).astype(np.uint16)
        yield RecordedFrame(
            BEGIN + number * TICK, pose, image.rgb, depth.astype(np.float32) / np.float32(TUM_SCALE)
        )


def seconds(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def raw(depth: np.ndarray, scale: int = TUM_SCALE) -> np.ndarray:
    return np.rint(depth.astype(np.float64) * scale).astype(np.uint16)


def quaternion(matrix: np.ndarray) -> list[float]:
    return Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()


def record_tum(folder: Path, frames: Sequence[RecordedFrame], camera: Camera) -> None:
    """Write a TUM RGB-D folder with poses of the camera."""
    lines: dict[str, list[str]] = {
        "rgb": ["# color images"],
        "depth": ["# depth maps"],
        "groundtruth": ["# poses"],
    }
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for stamp, pose, rgb, depth in frames:
        time = seconds(stamp)
        cv2.imwrite(str(folder / "rgb" / f"{time}.png"), rgb[..., ::-1])
        cv2.imwrite(str(folder / "depth" / f"{time}.png"), raw(depth))
        matrix = camera.to_world(pose)
        lines["rgb"].append(f"{time} rgb/{time}.png")
        lines["depth"].append(f"{time} depth/{time}.png")
        lines["groundtruth"].append(
            " ".join([time, *map(repr, [*matrix[:3, 3].tolist(), *quaternion(matrix)])])
        )
    for name, text in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(text) + "\n")


def record_folder(folder: Path, frames: Sequence[RecordedFrame], camera: Camera) -> None:
    """Write a plain folder with poses of the robot."""
    folder.mkdir(parents=True)
    k = Intrinsics.of(camera)
    colour = {name: getattr(k, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    mount = {"mount_height": camera.mount_height, "pitch": float(np.rad2deg(camera.pitch))}
    (folder / "camera.yaml").write_text(yaml.safe_dump({"colour": colour, "depth_scale": TUM_SCALE, **mount}))
    rows = ["time,colour,depth,x,y,theta"]
    for number, (stamp, pose, rgb, depth) in enumerate(frames):
        cv2.imwrite(str(folder / f"c{number}.png"), rgb[..., ::-1])
        np.save(folder / f"d{number}.npy", depth)
        rows.append(",".join([seconds(stamp), f"c{number}.png", f"d{number}.npy", *map(repr, pose)]))
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")


class Messages:
    """Factory of ROS messages of a type store; ROS 1 has other field names and header sequence numbers."""

    def __init__(self, store: Any, ros1: bool = False) -> None:
        self.store, self.ros1 = store, ros1

    def make(self, name: str, **values: Any) -> Any:
        package, kind = name.split("/")
        return self.store.types[f"{package}/msg/{kind}"](**values)

    def header(self, stamp: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.make("std_msgs/Header", stamp=time, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def image(self, stamp: int, frame: str, encoding: str, array: np.ndarray) -> Any:
        data = np.ascontiguousarray(array)
        return self.make(
            "sensor_msgs/Image",
            header=self.header(stamp, frame),
            height=array.shape[0],
            width=array.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=data.nbytes // len(data),
            data=data.view(np.uint8).reshape(-1),
        )

    def compressed(self, stamp: int, frame: str, format: str, data: bytes) -> Any:
        header = self.header(stamp, frame)
        return self.make(
            "sensor_msgs/CompressedImage", header=header, format=format, data=np.frombuffer(data, np.uint8)
        )

    def info(self, stamp: int, frame: str, k: Intrinsics) -> Any:
        names = ("D", "K", "R", "P") if self.ros1 else ("d", "k", "r", "p")
        projection = np.column_stack([k.matrix, np.zeros(3)])
        arrays = np.array(k.distortion or [0.0] * 5), k.matrix.ravel(), np.eye(3).ravel(), projection.ravel()
        roi = self.make(
            "sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.make(
            "sensor_msgs/CameraInfo",
            header=self.header(stamp, frame),
            height=k.height,
            width=k.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **dict(zip(names, arrays, strict=True)),
        )

    def transform(self, stamp: int, parent: str, child: str, matrix: np.ndarray) -> Any:
        x, y, z, w = quaternion(matrix)
        place = dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
        return self.make(
            "tf2_msgs/TFMessage",
            transforms=[
                self.make(
                    "geometry_msgs/TransformStamped",
                    header=self.header(stamp, parent),
                    child_frame_id=child,
                    transform=self.make(
                        "geometry_msgs/Transform",
                        translation=self.make("geometry_msgs/Vector3", **place),
                        rotation=self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
                    ),
                )
            ],
        )

    def odometry(self, stamp: int, parent: str, child: str, matrix: np.ndarray) -> Any:
        x, y, z, w = quaternion(matrix)
        zero = self.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
        pose = self.make(
            "geometry_msgs/Pose",
            position=self.make(
                "geometry_msgs/Point", **dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
            ),
            orientation=self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
        )
        covariance = np.zeros(36)
        return self.make(
            "nav_msgs/Odometry",
            header=self.header(stamp, parent),
            child_frame_id=child,
            pose=self.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=covariance),
            twist=self.make(
                "geometry_msgs/TwistWithCovariance",
                twist=self.make("geometry_msgs/Twist", linear=zero, angular=zero),
                covariance=covariance,
            ),
        )


Topic = tuple[str, str, Any]
"""Name, type and message."""

COLOUR, DEPTH = "/camera/color/image_raw", "/camera/depth/image_rect_raw"
OPTICAL, BASE, ODOM, MAP = "camera_optical", "base_link", "odom", "map"


def base_to_world(pose: Pose) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, :2], matrix[:2, 3] = pose.matrix()[:2, :2], pose.matrix()[:2, 2]
    return matrix


def robot_messages(
    taken: RecordedFrame, camera: Camera, messages: Messages, first: bool, odometry: bool = False
) -> list[Topic]:
    """Return the messages that a robot publishes for one frame."""
    stamp, pose, rgb, depth = taken
    out: list[Topic] = []
    if first:
        fixed = messages.transform(stamp, BASE, OPTICAL, camera.to_robot())
        out.append(("/tf_static", "tf2_msgs/msg/TFMessage", fixed))
    if odometry:
        out.append(
            ("/odom", "nav_msgs/msg/Odometry", messages.odometry(stamp, ODOM, BASE, base_to_world(pose)))
        )
    else:
        out.append(
            ("/tf", "tf2_msgs/msg/TFMessage", messages.transform(stamp, ODOM, BASE, base_to_world(pose)))
        )
        out.append(("/tf", "tf2_msgs/msg/TFMessage", messages.transform(stamp, MAP, ODOM, np.eye(4))))
    k = Intrinsics.of(camera)
    for topic in (COLOUR, DEPTH):
        name = topic.rpartition("/")[0] + "/camera_info"
        out.append((name, "sensor_msgs/msg/CameraInfo", messages.info(stamp, OPTICAL, k)))
    out.append((COLOUR, "sensor_msgs/msg/Image", messages.image(stamp, OPTICAL, "rgb8", rgb)))
    out.append((DEPTH, "sensor_msgs/msg/Image", messages.image(stamp, OPTICAL, "32FC1", depth)))
    return out


def record_bag(
    path: Path,
    frames: Sequence[RecordedFrame],
    camera: Camera,
    kind: str = "mcap",
    odometry: bool = False,
    change: Callable[[list[Topic], int], list[Topic]] = lambda topics, _: topics,
) -> None:
    """Write a bag of the kind mcap, sqlite3 or ros1; `change` may alter the messages of each frame."""
    ros1 = kind == "ros1"
    messages = Messages(ROS1 if ros1 else ROS2, ros1)
    writer = Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
    with writer:
        links: dict[str, Any] = {}
        for number, taken in enumerate(frames):
            for topic, name, message in change(
                robot_messages(taken, camera, messages, not number, odometry), number
            ):
                if topic not in links:
                    links[topic] = writer.add_connection(topic, name, typestore=messages.store)
                encode = messages.store.serialize_ros1 if ros1 else messages.store.serialize_cdr
                writer.write(links[topic], taken.stamp, encode(message, name))

"""All recording formats give the same frames of one drive; invalid entries are skipped, counted or refused."""

import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.recordings.bag import BagRecording
from imagination.recordings.cameras import camera_of
from imagination.recordings.folder import FolderRecording
from imagination.recordings.images import read_depth
from imagination.recordings.recording import BrokenRecordingError, Frame, Frames, Recording
from imagination.recordings.scannet import ScanNetRecording
from imagination.recordings.tum import Entry, TumRecording, associate, to_stamp
from imagination.utils.errors import UserError
from tests.helpers.robot import (
    BEGIN,
    ROS2,
    TICK,
    Messages,
    RecordedFrame,
    Topic,
    base_to_world,
    quaternion,
    raw,
    record_bag,
    record_folder,
    record_tum,
    seconds,
)

CAMERA = Camera.from_degrees(24, 16, 80.0, 1.1, pitch=10.0)
NO_TOPICS = dict.fromkeys(("colour", "depth", "colour_info", "depth_info", "odometry"))


def taken(count: int = 6) -> list[RecordedFrame]:
    rng = np.random.default_rng(0)
    return [
        RecordedFrame(
            BEGIN + number * TICK,
            Pose(0.1 * number, -0.2 * number, 0.3 * number),
            rng.integers(0, 256, (16, 24, 3), dtype=np.uint8),
            rng.integers(0, 30_000, (16, 24)).astype(np.float32) / np.float32(5000),
        )
        for number in range(count)
    ]


def tum(path: Path, **changes: Any) -> TumRecording:
    settings: dict[str, Any] = {"depth_scale": 5000.0, "max_difference": 0.02, "max_gap": 0.5}
    return TumRecording(str(path), RgbdCamera.of(CAMERA), **(settings | changes))


def bag(path: Path, **changes: Any) -> BagRecording:
    settings: dict[str, Any] = {
        "topics": NO_TOPICS,
        "world": None,
        "mount": None,
        "depth_scale": 1000.0,
        "max_difference": 0.02,
        "max_gap": 0.5,
    }
    return BagRecording(str(path), **(settings | changes))


def check(recording: Recording, wanted: list[RecordedFrame], tolerance: float = 0.0) -> None:
    frames = Frames(recording)
    got = list(frames)
    assert frames.mapped == len(got) == len(wanted)
    for frame, original in zip(got, wanted, strict=True):
        assert frame.stamp == original.stamp
        np.testing.assert_array_equal(frame.rgb, original.rgb)
        np.testing.assert_allclose(frame.depth, original.depth, atol=tolerance)
        np.testing.assert_allclose(frame.camera_to_world, CAMERA.to_world(original.pose), atol=1e-9)


def test_a_tum_folder(tmp_path: Path) -> None:
    record_tum(tmp_path / "tum", taken(), CAMERA)
    recording = tum(tmp_path / "tum")
    check(recording, taken())
    assert isinstance(recording, Recording) and not recording.skipped


def test_a_plain_folder(tmp_path: Path) -> None:
    record_folder(tmp_path / "plain", taken(), CAMERA)
    recording = FolderRecording(str(tmp_path / "plain"))
    check(recording, taken())
    assert recording.camera.mount_height == 1.1 and recording.camera.pitch == pytest.approx(np.deg2rad(10))


def test_a_plain_folder_with_poses_of_the_camera_and_frames_without(tmp_path: Path) -> None:
    record_folder(tmp_path / "plain", taken(3), CAMERA)
    rows = ["time,colour,depth,x,y,z,qx,qy,qz,qw"]
    for number, one in enumerate(taken(3)):
        matrix = CAMERA.to_world(one.pose)
        pose = map(repr, [*matrix[:3, 3].tolist(), *quaternion(matrix)])
        rows.append(
            ",".join(
                [seconds(one.stamp), f"c{number}.png", f"d{number}.npy", *(pose if number else [""] * 7)]
            )
        )
    (tmp_path / "plain" / "frames.csv").write_text("\n".join(rows))
    frames = Frames(FolderRecording(str(tmp_path / "plain")))
    assert [frame.stamp for frame in frames] == [one.stamp for one in taken(3)[1:]]
    assert frames.skipped == {"no pose at its time": 1}
    holes = np.mean([one.depth == 0 for one in taken(3)[1:]])
    assert f"{holes:.1%} of their depth pixels are holes" in frames.summary()


@pytest.mark.parametrize(
    ("kind", "odometry"), [("mcap", False), ("sqlite3", True), ("ros1", False), ("ros1", True)]
)
def test_a_bag(tmp_path: Path, kind: str, odometry: bool) -> None:
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    record_bag(path, taken(), CAMERA, kind, odometry)
    recording = bag(path)
    assert recording.world == ("odom" if odometry else "map")
    check(recording, taken())
    assert not recording.skipped
    if kind != "ros1":  # the file itself, too
        check(bag(next(path.glob("*.mcap" if kind == "mcap" else "*.db3"))), taken())


def test_a_bag_of_compressed_images(tmp_path: Path) -> None:
    from tests.helpers.robot import COLOUR, DEPTH, OPTICAL, ROS2, Messages

    messages = Messages(ROS2)

    def compress(topics: list[Topic], number: int) -> list[Topic]:
        one = taken()[number]
        png = cv2.imencode(".png", one.rgb[..., ::-1])[1].tobytes()
        millimetres = cv2.imencode(".png", raw(one.depth, 1000))[1].tobytes()
        colour = messages.compressed(one.stamp, OPTICAL, "rgb8; png compressed bgr8", png)
        depth = messages.compressed(one.stamp, OPTICAL, "16UC1; compressedDepth png", bytes(12) + millimetres)
        kind = "sensor_msgs/msg/CompressedImage"
        others = [topic for topic in topics if topic[0] not in (COLOUR, DEPTH)]
        return [*others, (f"{COLOUR}/compressed", kind, colour), (f"{DEPTH}/compressedDepth", kind, depth)]

    record_bag(tmp_path / "drive", taken(), CAMERA, change=compress)
    check(bag(tmp_path / "drive"), taken(), tolerance=0.00051)


def test_compressed_float_depth_is_inverse(tmp_path: Path) -> None:
    """compressed_depth_image_transport: a / depth + b in 16 bits."""
    import struct

    from imagination.recordings.images import decode_compressed_depth

    depth = np.array([[0.0, 0.5, 2.0, 9.5]], np.float32)
    a, b = 500.0, 12.5
    coded = np.where(depth > 0, a / np.maximum(depth, 1e-3) + b, 0).astype(np.uint16)
    data = struct.pack("<iff", 0, a, b) + cv2.imencode(".png", coded)[1].tobytes()
    got = decode_compressed_depth(data, "32FC1; compressedDepth png", "x")
    np.testing.assert_allclose(got, depth, rtol=0.02)


def test_a_bag_without_the_transform_of_the_camera_to_the_robot(tmp_path: Path) -> None:
    def without(topics: list[Topic], _: int) -> list[Topic]:
        return [topic for topic in topics if topic[0] != "/tf_static"]

    record_bag(tmp_path / "drive", taken(), CAMERA, change=without)
    with pytest.raises(UserError, match="recording.mount"):
        bag(tmp_path / "drive")
    mount = {"frame": "base_link", "height": 1.1, "pitch": 10.0}
    check(bag(tmp_path / "drive", mount=mount), taken())

    def within_the_camera(topics: list[Topic], number: int) -> list[Topic]:
        """As drivers publish it: the optical frame in camera_link, without a transform to the robot."""
        optical = np.array([[0, 0, 1, 0.02], [-1, 0, 0, 0.015], [0, -1, 0, 0.01], [0, 0, 0, 1.0]])
        fixed = Messages(ROS2).transform(BEGIN, "camera_link", "camera_optical", optical)
        own = [("/tf_static", "tf2_msgs/msg/TFMessage", fixed)] if not number else []
        return [*own, *without(topics, number)]

    record_bag(tmp_path / "driver", taken(), CAMERA, change=within_the_camera)
    check(bag(tmp_path / "driver", mount=mount), taken())
    with pytest.raises(UserError, match="mount: got .*base_link"):
        bag(tmp_path / "drive", mount={"frame": "base_link"})


def test_poses_are_interpolated_to_the_images_time(tmp_path: Path) -> None:
    from tests.helpers.robot import ROS2, Messages

    messages = Messages(ROS2)

    def move(topics: list[Topic], number: int) -> list[Topic]:
        """Transforms 50 ms before and after each image, on the same line."""
        out = [topic for topic in topics if topic[0] != "/tf"]
        for side in (-1, 1):
            stamp = taken()[number].stamp + side * TICK // 2
            at = Pose(0.1 * (number + side / 2), -0.2 * (number + side / 2), 0.3 * (number + side / 2))
            message = messages.transform(stamp, "odom", "base_link", base_to_world(at))
            out.append(("/tf", "tf2_msgs/msg/TFMessage", message))
        return out

    record_bag(tmp_path / "drive", taken(), CAMERA, change=move)
    recording = bag(tmp_path / "drive")
    check(recording, taken())
    assert recording.skipped == {"repeated transform": 5}


def test_a_scannet_folder(tmp_path: Path) -> None:
    beside = np.eye(4)
    beside[0, 3] = 0.03
    for name in ("color", "depth", "pose", "intrinsic"):
        (tmp_path / name).mkdir()
    k = Intrinsics.of(CAMERA)
    np.savetxt(
        tmp_path / "intrinsic" / "intrinsic_color.txt", np.pad(k.matrix, (0, 1)) + np.diag([0, 0, 0, 1.0])
    )
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_depth.txt", k.matrix * 0.5 + np.diag([0, 0, 0.5]))
    np.savetxt(tmp_path / "intrinsic" / "extrinsic_color.txt", beside)
    frames = taken()
    for number, one in enumerate(frames):
        cv2.imwrite(str(tmp_path / "color" / f"{number}.png"), one.rgb[..., ::-1])
        suffix = "pgm" if number % 2 else "png"
        cv2.imwrite(str(tmp_path / "depth" / f"{number}.{suffix}"), raw(one.depth[::2, ::2], 1000))
        pose = CAMERA.to_world(one.pose) @ np.linalg.inv(beside)
        np.savetxt(tmp_path / "pose" / f"{number}.txt", np.full((4, 4), -np.inf) if number == 2 else pose)
    (tmp_path / "pose" / "5.txt").unlink()
    recording = ScanNetRecording(str(tmp_path), 1000.0, 10.0)
    got = Frames(recording)
    for frame, number in zip(got, (0, 1, 3, 4), strict=True):
        assert frame.stamp == number * TICK
        np.testing.assert_array_equal(frame.rgb, frames[number].rgb)
        np.testing.assert_allclose(frame.depth, frames[number].depth[::2, ::2], atol=0.00051)
        np.testing.assert_allclose(frame.camera_to_world, CAMERA.to_world(frames[number].pose), atol=1e-9)
    assert got.skipped == {"no pose at its time": 2}
    assert recording.camera.depth is not None and recording.camera.depth.width == 12
    np.testing.assert_allclose(recording.camera.depth_to_colour, np.linalg.inv(beside))
    (tmp_path / "pose" / "1.txt").write_text("1 0 0")
    recording = ScanNetRecording(str(tmp_path), 1000.0, 10.0)
    assert [frame.stamp // TICK for frame in Frames(recording)] == [0, 3, 4]
    assert recording.skipped == {"invalid pose": 1}
    (tmp_path / "intrinsic" / "intrinsic_depth.txt").write_text("1 2\n3 4\n")
    with pytest.raises(UserError, match=r"intrinsic_depth.txt: got .*\(2, 2\)"):
        ScanNetRecording(str(tmp_path), 1000.0, 10.0)
    with pytest.raises(UserError, match="color: got no file"):
        ScanNetRecording(str(tmp_path / "intrinsic"), 1000.0, 10.0)


def edit(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def test_lists_that_are_out_of_order_or_repeat_themselves(tmp_path: Path) -> None:
    folder = tmp_path / "tum"
    record_tum(folder, taken(), CAMERA)
    edit(folder / "rgb.txt", lambda lines: [*lines[:3], lines[2], *lines[4:6], lines[3], lines[6]])
    edit(
        folder / "groundtruth.txt",
        lambda lines: [*lines[:5], f"{lines[5].split()[0]} 1 2 nan 0 0 0 1", lines[6]],
    )
    recording = tum(folder, max_gap=0.15)
    frames = Frames(recording)
    stamps = [(frame.stamp - BEGIN) // TICK for frame in frames]
    assert stamps == [0, 1, 3, 5]
    assert frames.skipped == {
        "repeated time stamp in rgb.txt": 1,
        "time stamp out of order in rgb.txt": 1,
        "invalid pose": 1,
        "no pose at its time": 1,
    }
    assert "4 frames mapped, 4 skipped" in frames.summary() and "1 x invalid pose" in frames.summary()


def test_frames_out_of_order_are_skipped(tmp_path: Path) -> None:
    record_folder(tmp_path / "plain", taken(), CAMERA)
    edit(tmp_path / "plain" / "frames.csv", lambda rows: [*rows[:4], rows[3], rows[2], rows[5]])
    frames = Frames(FolderRecording(str(tmp_path / "plain")))
    assert [(frame.stamp - BEGIN) // TICK for frame in frames] == [0, 1, 2, 4]
    assert frames.skipped == {"time stamp out of order": 1, "repeated time stamp": 1}


def test_a_stray_pose_costs_its_frame(tmp_path: Path) -> None:
    drive = taken()
    drive[2] = drive[2]._replace(pose=Pose(40.0, 0.0, 0.0))
    record_folder(tmp_path / "plain", drive, CAMERA)
    frames = Frames(FolderRecording(str(tmp_path / "plain")))
    assert [(frame.stamp - BEGIN) // TICK for frame in frames] == [0, 1, 3, 4, 5]
    assert frames.skipped == {"jump of the pose": 1}
    assert (
        "the first jump: pose: got (40.00, 0.00, 1.10) m 0.10 s after (0.10, -0.20, 1.10)" in frames.summary()
    )


def test_rows_that_are_damaged(tmp_path: Path) -> None:
    """A frame with an invalid pose is skipped, as in a TUM folder; an unreadable row ends the recording."""
    folder = tmp_path / "plain"
    record_folder(folder, taken(4), CAMERA)
    head = "time,colour,depth,x,y,z,qx,qy,qz,qw"
    rows = [f"{number},c{number}.png,d{number}.npy,0,0,1.1,0,0,0,{int(number != 1)}" for number in range(4)]
    (folder / "frames.csv").write_text("\n".join([head, *rows]))
    frames = Frames(FolderRecording(str(folder)))
    assert [frame.stamp // 10**9 for frame in frames] == [0, 2, 3]
    assert frames.skipped == {"invalid pose": 1}
    for row, expected in (
        ("inf" + rows[3][1:], "line 5: time 'inf'"),
        ("3,c3.png", "line 5: got too few columns"),
    ):
        (folder / "frames.csv").write_text("\n".join([head, *rows[:3], row]))
        got, message = until_broken(FolderRecording(str(folder)))
        assert len(got) == 2 and expected in message


def test_a_depth_camera_and_distortion_of_a_tum_folder() -> None:
    from hydra.utils import instantiate

    from imagination.config.compose import compose

    values = "recording.camera.values"
    camera = instantiate(
        compose(
            "map",
            [
                f"{values}.colour.distortion=[0.1,0,0,0]",
                f"{values}.depth={{width:320,height:240,fx:260,fy:260,cx:160,cy:120}}",
                f"{values}.depth_to_colour=[[1,0,0,0.03],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
            ],
        ).recording.camera,
        _convert_="all",
    )
    assert camera.colour.distortion == (0.1, 0, 0, 0) and camera.depth.width == 320
    assert camera.depth_to_colour[0, 3] == 0.03


UNTYPED = """
import sys
from pathlib import Path
from imagination.config.compose import compose
from imagination.deployment import mapper_from_config as configured
from imagination.utils.errors import UserError
from imagination.recordings.cameras import camera_of, mount_of
from imagination.recordings.folder import FolderRecording

colour = {"width": 24, "height": 16, "fx": 20.0, "fy": 20.0, "cx": 11.5, "cy": 7.5}
calls = [lambda mount=mount: mount_of(mount) for mount in ("base_link", 5, {"frame": "a", "height": None})]
for values in (
    {"colour": colour | {"fx": "525 px"}},
    {"colour": colour, "mount_height": "1.2 m"},
    {"colour": colour, "depth_to_colour": [[1, 0], [0]]},
    {"colour": "red"},
    {"colour": colour, "pitch": "down"},
):
    calls.append(lambda values=values: camera_of(values))
for scale in ("mm", "null"):
    def read(scale=scale):
        Path(sys.argv[1], "camera.yaml").write_text(f"depth_scale: {scale}")
        FolderRecording(sys.argv[1])
    calls.append(read)
for override in ("threshold=abc", "floor_height=low"):
    config = compose("map", ["unit=a.onnx", override])
    calls.append(lambda config=config: configured.validate(config))
class Units:
    class spec:
        class ego:
            resolution = 0.1
for overrides in (["extent=big"], ["extent=5", "centre=[1]"], ["extent=5", "centre=[x,y]"]):
    config = compose("map", ["unit=a.onnx", *overrides])
    calls.append(lambda config=config: configured.mapper_of(config, Units, None))
for call in calls:
    try:
        call()
    except UserError as error:
        print(error)
"""


def test_values_of_a_wrong_kind_get_one_message(tmp_path: Path) -> None:
    """In a process without the type checker of the tests, which would raise first."""
    import subprocess
    import sys

    done = subprocess.run([sys.executable, "-c", UNTYPED, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    messages = done.stdout.splitlines()
    assert len(messages) == 15 and all(": " in line for line in messages), done.stdout
    assert "threshold: got abc," in done.stdout and "floor_height: got low," in done.stdout
    assert "centre: got [1]," in done.stdout


def test_association_is_the_closest_first() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        colour = sorted(rng.choice(1000, 30, replace=False).tolist())
        depth = sorted(rng.choice(1000, 25, replace=False).tolist())
        got = associate([Entry(stamp, []) for stamp in colour], [Entry(stamp, []) for stamp in depth], 20)
        pairs = sorted(
            (abs(c - d), i, j) for i, c in enumerate(colour) for j, d in enumerate(depth) if abs(c - d) <= 20
        )
        wanted, left, right = [], set(colour), set(depth)
        for _, i, j in pairs:
            if colour[i] in left and depth[j] in right:
                wanted.append((colour[i], depth[j]))
                left.discard(colour[i])
                right.discard(depth[j])
        assert [(c.stamp, d.stamp) for c, d in got] == sorted(wanted)


def test_stamps_are_exact() -> None:
    assert to_stamp("1700000000.123456789") == 1_700_000_000_123_456_789
    assert to_stamp("12") == 12 * 10**9 and to_stamp("0.5") == 5 * 10**8 and to_stamp("1e1") == 10**10


def until_broken(recording: Recording) -> tuple[list[Frame], str]:
    got = []
    with pytest.raises(BrokenRecordingError) as error:
        for frame in Frames(recording):
            got.append(frame)
    return got, str(error.value)


def test_a_corrupt_image_ends_it_where_it_is(tmp_path: Path) -> None:
    record_tum(tmp_path / "tum", taken(), CAMERA)
    image = tmp_path / "tum" / "depth" / f"{seconds(taken()[3].stamp)}.png"
    image.write_bytes(image.read_bytes()[:30])
    got, message = until_broken(tum(tmp_path / "tum"))
    assert len(got) == 3 and f"{image}: got 30 bytes" in message
    image.unlink()
    assert "cannot be read (No such file" in until_broken(tum(tmp_path / "tum"))[1]
    listed = tmp_path / "tum" / "rgb.txt"
    listed.write_text(listed.read_text().replace("rgb/", "rgb/\0"))
    assert "cannot be read (embedded null byte)" in until_broken(tum(tmp_path / "tum"))[1]
    listed.write_text(listed.read_text().replace("\0", ""))
    cv2.imwrite(str(image), np.zeros((16, 24, 3), np.uint8))
    assert f"{image}: got uint8" in until_broken(tum(tmp_path / "tum"))[1]


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_a_damaged_bag_gives_the_frames_before_the_damage(tmp_path: Path, kind: str) -> None:
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    frames = taken(40)
    record_bag(path, frames, CAMERA, kind)
    file = path if kind == "ros1" else next(path.glob("drive*.*"))
    data = bytearray(file.read_bytes())
    middle = data.find(frames[25].rgb.tobytes()[:64])  # in the colour image of frame 25
    assert middle > 0
    start = data.rfind(b"camera_optical", 0, middle)
    data[start - 8 : start + 4] = b"\xff" * 12  # the length of the frame's name, among others
    file.write_bytes(data)
    got, message = until_broken(bag(path))
    assert 10 <= len(got) <= 25
    for frame, original in zip(got, frames, strict=False):
        np.testing.assert_array_equal(frame.rgb, original.rgb)
    assert "damaged after" in message or "after its start" in message


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_a_truncated_bag_gives_the_remaining_frames(tmp_path: Path, kind: str) -> None:
    """Cut in its only chunk; and a recorder that was killed before it wrote metadata.yaml."""
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    frames = taken(60)
    record_bag(path, frames, CAMERA, kind)
    file = path if kind == "ros1" else next(path.glob("drive*.*"))
    whole = file.read_bytes()
    file.write_bytes(whole[: round(0.7 * len(whole))])
    for place in {file, path}:
        got, message = until_broken(bag(place))
        assert 30 <= len(got) <= 45
        for frame, original in zip(got, frames, strict=False):
            assert frame.stamp == original.stamp
            np.testing.assert_array_equal(frame.rgb, original.rgb)
            np.testing.assert_array_equal(frame.depth, original.depth)
            np.testing.assert_allclose(frame.camera_to_world, CAMERA.to_world(original.pose), atol=1e-9)
        assert file.name in message and f" {file.stat().st_size} bytes" in message
        assert (
            f"damaged after {2 * len(got)} messages" in message
            or f"after {2 * len(got) + 1} messages" in message
        )
    if kind != "ros1":
        file.write_bytes(whole)
        (path / "metadata.yaml").unlink()
        check(bag(path), frames)
    file.write_bytes(whole[:100])
    with pytest.raises(UserError, match="(drive.bag|drive|noise.mcap): cannot be opened"):
        bag(path)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_the_files_of_a_split_bag_are_read_in_their_order(tmp_path: Path, kind: str) -> None:
    """Of a recorder that was killed before it wrote metadata.yaml: _2 comes before _10."""
    frames, folder = taken(24), tmp_path / "drive"
    folder.mkdir()
    for number in range(12):
        part = tmp_path / f"part{number}"
        record_bag(part, frames[2 * number : 2 * number + 2], CAMERA, kind)
        (file,) = part.glob("part*.*")
        file.rename(folder / f"drive_{number}{file.suffix}")
    check(bag(folder), frames)


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4", "zstd"])
def test_a_truncated_chunk_is_decompressed_up_to_its_end(compression: str) -> None:
    import bz2

    import lz4.frame

    from imagination.recordings.cut_bags import decompress, zstd

    pack = {"none": bytes, "bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": zstd.compress}[compression]
    data = np.random.default_rng(0).integers(0, 99, 4_000_000, dtype=np.uint8).tobytes()
    packed = pack(data)
    assert decompress(compression, packed, len(data)) == data
    part = decompress(compression, packed[: len(packed) * 7 // 10], len(data))
    assert 0.4 * len(data) < len(part) < 0.8 * len(data) and data.startswith(part)


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_a_chunk_decompresses_to_at_most_its_stated_size(
    compression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of MCAP and of ROS 1, also for a nested chunk."""
    import bz2

    import lz4.frame

    from imagination.recordings import cut_bags

    pack = {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": cut_bags.zstd.compress}[compression]

    def sized(data: bytes) -> bytes:
        return struct.pack("<I", len(data)) + data

    def mcap_chunk(content: bytes, stated: int) -> bytes:
        data = pack(content)
        body = struct.pack("<QQQI", 0, 0, stated, 0) + sized(compression.encode())
        body += struct.pack("<Q", len(data)) + data
        return struct.pack("<BQ", 6, len(body)) + body

    def ros1_chunk(content: bytes, stated: int) -> bytes:
        values = (b"op=\5", b"compression=" + compression.encode(), b"size=" + struct.pack("<I", stated))
        return sized(b"".join(map(sized, values))) + sized(pack(content))

    message = bytes(1_000_000)
    for chunk, records, inner in (
        (mcap_chunk, cut_bags.mcap_records, struct.pack("<BQ", 5, len(message)) + message),
        (ros1_chunk, cut_bags.ros1_records, sized(sized(b"op=\2")) + sized(message)),
    ):
        whole = chunk(inner, len(inner))
        assert [record[-1] for record in records(BytesIO(whole))] == [message]
        with pytest.raises(BrokenRecordingError, match="chunk: got .* 999"):
            list(records(BytesIO(chunk(inner, 999))))
        assert [record[-1] for record in records(BytesIO(chunk(whole, len(whole))))] != [message]
        monkeypatch.setattr(cut_bags, "MAX_RECORD", len(whole))
        with pytest.raises(BrokenRecordingError, match=f"chunk: got .* {len(whole)}"):
            list(records(BytesIO(whole)))
        monkeypatch.undo()


def test_one_damaged_transform_costs_only_itself(tmp_path: Path) -> None:
    import sqlite3

    record_bag(tmp_path / "drive", taken(30), CAMERA, "sqlite3")
    database = sqlite3.connect(next((tmp_path / "drive").glob("*.db3")))
    ids = "SELECT m.id FROM messages m JOIN topics t ON m.topic_id = t.id WHERE t.name = '/tf' ORDER BY m.id"
    (number,) = database.execute(ids).fetchall()[20]  # of frame 10
    database.execute("UPDATE messages SET data = ? WHERE id = ?", (bytes([0, 1, 0, 0]) + b"\xff" * 4, number))
    database.commit()
    database.close()
    recording = bag(tmp_path / "drive")
    assert len(list(Frames(recording))) == 30  # between its neighbours the pose is interpolated
    assert recording.skipped == {"undecodable message of /tf": 1}


def test_a_bag_of_before_tf2(tmp_path: Path) -> None:
    from rosbags.typesys import get_types_from_msg

    from tests.helpers.robot import ROS1

    ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf/msg/tfMessage"))

    def old(topics: list[Topic], _: int) -> list[Topic]:
        make = ROS1.types["tf/msg/tfMessage"]
        return [
            (name, "tf/msg/tfMessage", make(transforms=message.transforms)) if "/tf" in name else topic
            for topic in topics
            for name, _, message in [topic]
        ]

    record_bag(tmp_path / "old.bag", taken(), CAMERA, "ros1", change=old)
    check(bag(tmp_path / "old.bag"), taken())


def test_frames_and_topics_that_the_user_gives(tmp_path: Path) -> None:
    record_bag(tmp_path / "drive", taken(2), CAMERA)
    recording = bag(tmp_path / "drive", world="/odom")
    assert recording.world == "odom"
    check(recording, taken(2))
    image = "/camera/color/image_raw"
    for role, topic, expected in (
        ("colour", "/tf", "recording.topics.colour: got /tf .*tf2_msgs/msg/TFMessage"),
        (
            "colour_info",
            image,
            "recording.topics.colour_info: got .*sensor_msgs/msg/Image, expected .*CameraInfo",
        ),
        ("odometry", image, "recording.topics.odometry: got .*sensor_msgs/msg/Image, expected .*Odometry"),
    ):
        with pytest.raises(UserError, match=expected):
            bag(tmp_path / "drive", topics=NO_TOPICS | {role: topic})


def test_a_message_that_is_no_image_ends_it_with_its_place(tmp_path: Path) -> None:
    def shorten(topics: list[Topic], number: int) -> list[Topic]:
        for name, _, message in topics:
            if number == 4 and name.endswith("image_raw"):
                message.data = message.data[:-7]
        return topics

    record_bag(tmp_path / "drive", taken(), CAMERA, change=shorten)
    got, message = until_broken(bag(tmp_path / "drive"))
    assert len(got) == 4
    assert "0.400 s after its start: Image: got 1145 bytes for 24 x 16 pixels of rgb8" in message


def test_bags_that_cannot_be_read_at_all(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="recording.path: got .*none.bag"):
        bag(tmp_path / "none.bag")
    (tmp_path / "noise.mcap").write_bytes(bytes(range(256)) * 20)
    with pytest.raises(UserError, match="(drive.bag|drive|noise.mcap): cannot be opened"):
        bag(tmp_path / "noise.mcap")
    record_bag(tmp_path / "drive", taken(2), CAMERA)
    with pytest.raises(UserError, match=r"recording.topics: got /camera/rgb, .*/camera/color/camera_info"):
        bag(tmp_path / "drive", topics=NO_TOPICS | {"colour": "/camera/rgb"})
    with pytest.raises(UserError, match="'earth'.*camera_optical in base_link in odom in map"):
        bag(tmp_path / "drive", world="earth")
    record_bag(
        tmp_path / "blind",
        taken(2),
        CAMERA,
        change=lambda topics, _: [t for t in topics if "depth" not in t[0]],
    )
    with pytest.raises(UserError, match=r"recording.topics.depth: got none"):
        bag(tmp_path / "blind")
    record_bag(
        tmp_path / "lost", taken(2), CAMERA, change=lambda topics, _: [t for t in topics if "/tf" not in t[0]]
    )
    with pytest.raises(UserError, match="recording.topics.odometry: got none"):
        bag(tmp_path / "lost")


def test_depth_with_holes_and_of_every_kind(tmp_path: Path) -> None:
    depth = np.array([[0.0, np.nan, np.inf, -1.0, 2.5]], np.float32)
    np.save(tmp_path / "d.npy", depth)
    assert read_depth(tmp_path / "d.npy", 1000.0).tolist() == [[0, 0, 0, 0, 2.5]]
    (tmp_path / "d.pgm").write_bytes(b"P5\n2 1\n65535\n" + np.array([[0, 1500]], ">u2").tobytes())
    assert read_depth(tmp_path / "d.pgm", 1000.0).tolist() == [[0, 1.5]]
    cv2.imwrite(str(tmp_path / "d.png"), np.array([[5000, 65535]], np.uint16))
    np.testing.assert_allclose(read_depth(tmp_path / "d.png", 5000.0), [[1.0, 13.107]])
    np.save(tmp_path / "d.npy", np.zeros((2, 2, 2), np.float32))
    with pytest.raises(BrokenRecordingError, match="d.npy: got"):
        read_depth(tmp_path / "d.npy", 1000.0)


def test_a_small_file_of_a_large_image_is_refused() -> None:
    from imagination.recordings.images import decode_colour

    data = bytearray(cv2.imencode(".png", np.zeros((9, 9, 3), np.uint8))[1].tobytes())
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    with pytest.raises(BrokenRecordingError, match="x: got 60000 x 60000 pixels, .*8192"):
        decode_colour(bytes(data), "x")


def test_broken_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="rgb.txt: cannot be read"):
        tum(tmp_path)
    for name in ("rgb", "depth", "groundtruth"):
        (tmp_path / f"{name}.txt").write_text("# nothing\n")
    with pytest.raises(UserError, match="rgb.txt: got no entry"):
        tum(tmp_path)
    (tmp_path / "rgb.txt").write_text("yesterday rgb/1.png\n")
    with pytest.raises(UserError, match=r"rgb.txt, line 1: got 'yesterday rgb/1.png'"):
        tum(tmp_path)
    with pytest.raises(UserError, match=r"camera.yaml: there is no such file"):
        FolderRecording(str(tmp_path))
    for text in ("a: 2026-13-45", "a: !!bool x", "a: " + 5000 * "9", 3000 * "["):
        (tmp_path / "camera.yaml").write_text(text)
        with pytest.raises(UserError, match=r"camera.yaml: cannot be read"):
            FolderRecording(str(tmp_path))
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump({"colour": {"width": 24}}))
    with pytest.raises(UserError, match="camera.yaml: a value cannot be read"):
        FolderRecording(str(tmp_path))
    colour = {"width": 24, "height": 16, "fx": 20.0, "fy": -20.0, "cx": 11.5, "cy": 7.5}
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump({"colour": colour}))
    (tmp_path / "frames.csv").write_text("time,colour,depth\n1,a,b\n")
    with pytest.raises(UserError, match="frames.csv: got 1 rows"):
        FolderRecording(str(tmp_path))
    with pytest.raises(UserError, match="got .* colr"):
        camera_of({"colour": colour, "colr": 1})
    assert camera_of({"colour": colour}).colour.fy == -20.0

"""Parsers of recordings: bags, TUM, ScanNet and plain folders."""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np

from imagination.geometry.camera import Camera
from imagination.geometry.pose import Pose
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.recordings.bag import BagRecording
from imagination.recordings.folder import FolderRecording
from imagination.recordings.recording import Frames, Recording
from imagination.recordings.scannet import ScanNetRecording
from imagination.recordings.tum import TumRecording
from tests.helpers.robot import (
    BEGIN,
    TICK,
    RecordedFrame,
    raw,
    record_bag,
    record_folder,
    record_tum,
    seconds,
)
from tests.robustness.parsers.parser import Examples, Parse, Parser, temporary_folder, with_file_replaced

CAMERA = Camera.from_degrees(24, 16, 80.0, 1.1)


@cache
def frames() -> list[RecordedFrame]:
    image, depth = np.full((16, 24, 3), 90, np.uint8), np.full((16, 24), 2, np.float32)
    return [
        RecordedFrame(BEGIN + number * TICK, Pose(0.1 * number, 0, 0), image, depth) for number in range(4)
    ]


def read_frames(open_recording: Callable[[Path], Recording]) -> Callable[[Path], object]:
    """Return a reader of all frames of a recording."""
    return lambda folder: len(list(Frames(open_recording(folder))))


def open_bag(file: str, folder: Path) -> BagRecording:
    topics = dict.fromkeys(("colour", "depth", "colour_info", "depth_info", "odometry"))
    return BagRecording(str(folder / file), topics, None, None, 1000.0, 0.02, 0.5)


def bag(kind: str) -> tuple[Parse, Examples]:
    """Return a parser of a bag of one file, and an example."""
    suffix = {"mcap": ".mcap", "sqlite3": ".db3", "ros1": ".bag"}[kind]

    def record(folder: Path) -> None:
        folder.mkdir()
        record_bag(folder / ("drive.bag" if kind == "ros1" else "drive"), frames(), CAMERA, kind)
        next(folder.rglob(f"drive{suffix}")).rename(folder / f"bag{suffix}")

    name = f"bag{suffix}"
    return with_file_replaced(temporary_folder(record), name, read_frames(partial(open_bag, name)))


def record_scannet(folder: Path) -> None:
    """Write a recording in the export layout of ScanNet."""
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    for name in ("color", "depth"):
        np.savetxt(folder / "intrinsic" / f"intrinsic_{name}.txt", Intrinsics.of(CAMERA).matrix)
        np.savetxt(folder / "intrinsic" / f"extrinsic_{name}.txt", np.eye(4))
    for number, frame in enumerate(frames()):
        cv2.imwrite(str(folder / "color" / f"{number}.png"), frame.rgb)
        cv2.imwrite(str(folder / "depth" / f"{number}.png"), raw(frame.depth, 1000))
        np.savetxt(folder / "pose" / f"{number}.txt", CAMERA.to_world(frame.pose))


def images() -> list[bytes]:
    """Return colour images of a recording."""
    picture = np.random.default_rng(0).integers(0, 256, (16, 24, 3), np.uint8)
    return [cv2.imencode(suffix, picture)[1].tobytes() for suffix in (".png", ".jpg")]


def depths() -> list[bytes]:
    """Return depth images of a recording."""
    return [cv2.imencode(".png", raw(frames()[0].depth, 1000))[1].tobytes()]


TUM = temporary_folder(lambda folder: record_tum(folder, frames(), CAMERA))
SCANNET = temporary_folder(record_scannet)
FOLDER = temporary_folder(lambda folder: record_folder(folder, frames(), CAMERA))
SQLITE3, MCAP = (
    temporary_folder(partial(record_bag, frames=frames(), camera=CAMERA, kind=kind))
    for kind in ("sqlite3", "mcap")
)

tum = read_frames(lambda folder: TumRecording(str(folder), RgbdCamera.of(CAMERA), 5000.0, 0.02, 0.5))
scannet = read_frames(lambda folder: ScanNetRecording(str(folder), 1000.0, 30.0))
plain = read_frames(lambda folder: FolderRecording(str(folder)))

PARSERS = [
    *(Parser(f"bag-{kind}", *bag(kind)) for kind in ("mcap", "sqlite3", "ros1")),
    *(
        Parser(
            f"bag-metadata-{kind}",
            *with_file_replaced(made, "metadata.yaml", read_frames(partial(open_bag, ""))),
        )
        for kind, made in (("sqlite3", SQLITE3), ("mcap", MCAP))
    ),
    *(
        Parser(f"tum-{name}", *with_file_replaced(TUM, f"{name}.txt", tum))
        for name in ("rgb", "depth", "groundtruth")
    ),
    Parser("tum-image", with_file_replaced(TUM, f"rgb/{seconds(frames()[2].stamp)}.png", tum)[0], images),
    Parser(
        "tum-depth-image", with_file_replaced(TUM, f"depth/{seconds(frames()[2].stamp)}.png", tum)[0], depths
    ),
    Parser("scannet-pose", *with_file_replaced(SCANNET, "pose/2.txt", scannet)),
    Parser("scannet-intrinsic", *with_file_replaced(SCANNET, "intrinsic/intrinsic_color.txt", scannet)),
    Parser("scannet-extrinsic", *with_file_replaced(SCANNET, "intrinsic/extrinsic_depth.txt", scannet)),
    Parser("scannet-color", with_file_replaced(SCANNET, "color/2.png", scannet)[0], images),
    Parser("scannet-depth", *with_file_replaced(SCANNET, "depth/2.png", scannet)),
    *(
        Parser(f"folder-{name}", *with_file_replaced(FOLDER, name, plain))
        for name in ("camera.yaml", "frames.csv", "d2.npy")
    ),
    Parser("folder-image", with_file_replaced(FOLDER, "c2.png", plain)[0], images),
]

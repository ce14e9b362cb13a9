"""Recordings in plain folders: image files, a table of poses and a YAML file of the camera (docs/how-to/robot.md)."""

import csv
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from imagination.geometry.pose import Pose
from imagination.recordings.cameras import camera_of
from imagination.recordings.images import read_colour, read_depth
from imagination.recordings.recording import BrokenRecordingError, Images, Shot
from imagination.recordings.trajectory import matrix_of
from imagination.recordings.tum import to_stamp
from imagination.utils.errors import UserError, check_range
from imagination.utils.tabular import read_yaml

PLANAR, FULL = ("x", "y", "theta"), ("x", "y", "z", "qx", "qy", "qz", "qw")
"""Pose columns of frames.csv: planar pose of the robot, or full pose of the colour camera."""


class FolderRecording:
    """Recording in a plain folder.

    camera.yaml: `colour` (width, height, fx, fy, cx, cy, distortion), `depth` for a separate depth camera, with
    `depth_to_colour` (4 x 4) if its position differs; `depth_scale`; for planar poses `mount_height`, `pitch` and
    `roll` (degrees). frames.csv: time, colour, depth (paths in the folder), and x, y, theta of the robot or x, y, z,
    qx, qy, qz, qw of the colour camera; empty columns mean no pose.

    Args:
        path: path of the folder.
        floor_height: world z of the floor for planar poses, metres.

    Raises:
        UserError: if a file is missing or damaged.
    """

    world = "map"  # the format has no frame id

    def __init__(self, path: str, floor_height: float = 0.0) -> None:
        self.folder, self.floor_height = Path(path), floor_height
        self.skipped: Counter[str] = Counter()
        values = read_yaml(self.folder / "camera.yaml", "the camera's keys")
        self.depth_scale = check_range(
            "camera.yaml: depth_scale", values.pop("depth_scale", 1000.0), 1.0, 1e6
        )
        self.camera = camera_of(values, str(self.folder / "camera.yaml"))
        try:
            with open(self.folder / "frames.csv", newline="") as file:
                reader = csv.DictReader(file)
                self.rows = list(reader)
                columns = set(reader.fieldnames or ())
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise UserError(f"{self.folder / 'frames.csv'}: cannot be read ({error})") from error
        self.pose_columns = next((names for names in (FULL, PLANAR) if columns.issuperset(names)), ())
        if not self.rows or not self.pose_columns or not columns.issuperset({"time", "colour", "depth"}):
            raise UserError(
                f"{self.folder / 'frames.csv'}: got {len(self.rows)} rows with the columns {sorted(columns)}, expected "
                f"time, colour, depth and {', '.join(PLANAR)} or {', '.join(FULL)}"
            )

    def shots(self) -> Iterator[Shot]:
        """Iterate over the rows of frames.csv; see `Recording`."""
        for number, row in enumerate(self.rows, 2):
            place = f"{self.folder / 'frames.csv'}, line {number}"
            if None in (row["time"], row["colour"], row["depth"]):
                raise BrokenRecordingError(f"{place}: got too few columns, expected time, colour and depth")
            try:
                stamp = to_stamp(row["time"])
                texts = [row[name] for name in self.pose_columns]
                numbers = [float(text) for text in texts] if all(texts) else None
            except ValueError as error:
                raise BrokenRecordingError(f"{place}: {error}") from error
            try:
                pose = None if numbers is None else self._pose(numbers)
            except UserError:
                self.skipped["invalid pose"] += 1
                continue
            yield Shot(stamp, pose, partial(self._load, row["colour"], row["depth"]))

    def _load(self, colour: str, depth: str) -> Images:
        return Images(read_colour(self.folder / colour), read_depth(self.folder / depth, self.depth_scale))

    def _pose(self, numbers: list[float]) -> Float64[np.ndarray, "4 4"]:
        if self.pose_columns == PLANAR:
            return self.camera.to_world(Pose(*numbers), self.floor_height)
        return matrix_of(numbers[:3], numbers[3:])

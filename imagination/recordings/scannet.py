"""Recordings in folders of exported ScanNet sensor files: color/, depth/, pose/ and intrinsic/, one file per frame."""

from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from imagination.geometry.rgbd import Intrinsics, RgbdCamera, check_transform
from imagination.recordings.images import read_colour, read_depth
from imagination.recordings.recording import Images, Shot
from imagination.recordings.trajectory import SECOND
from imagination.utils.errors import UserError, check_range


class ScanNetRecording:
    """Recording in a ScanNet folder: color/N.jpg, depth/N.png or .pgm, pose/N.txt (camera to world, 4 x 4, z up).

    intrinsic/ holds intrinsic_color.txt and intrinsic_depth.txt, and, for separate cameras, extrinsic_color.txt and
    extrinsic_depth.txt with the transforms from each camera to the frame of the poses. Frames without a pose (infinity
    in ScanNet) or with an invalid one are skipped.

    Args:
        path: path of the folder.
        depth_scale: units per metre of the depth images.
        rate: frames per second, since the files have no time stamps.

    Raises:
        UserError: if a folder or the intrinsics are missing or damaged.
    """

    world = "map"  # the format has no frame id

    def __init__(self, path: str, depth_scale: float, rate: float) -> None:
        self.folder = Path(path)
        self.depth_scale = check_range("recording.depth_scale", depth_scale, 1.0, 1e6, "units per metre")
        self.rate = check_range("recording.rate", rate, 0.001, 1000.0, "frames per second")
        self.skipped: Counter[str] = Counter()
        self.colour, self.depth, self.poses = (
            numbered(self.folder / name) for name in ("color", "depth", "pose")
        )
        if missing := len(self.colour.keys() - self.depth.keys()):
            self.skipped["colour image without a depth image"] += missing
        self.frames = sorted(self.colour.keys() & self.depth.keys())
        if not self.frames:
            raise UserError(
                f"{self.folder}: got no frame number in both color/ and depth/, expected color/0.jpg, depth/0.png"
            )
        colour, depth = (self._extrinsic(name) for name in ("color", "depth"))
        self._colour_to_pose = colour
        first = self.frames[0]
        sizes = read_colour(self.colour[first]).shape, read_depth(self.depth[first], depth_scale).shape
        self.camera = RgbdCamera(
            self._intrinsic("color", sizes[0]),
            self._intrinsic("depth", sizes[1]),
            np.linalg.inv(colour) @ depth,
        )

    def shots(self) -> Iterator[Shot]:
        """Iterate over the frames by number; see `Recording`."""
        for number in self.frames:
            try:
                pose = self._pose(number)
            except UserError:
                self.skipped["invalid pose"] += 1
                continue
            yield Shot(round(number * SECOND / self.rate), pose, partial(self._load, number))

    def _load(self, number: int) -> Images:
        return Images(read_colour(self.colour[number]), read_depth(self.depth[number], self.depth_scale))

    def _pose(self, number: int) -> Float64[np.ndarray, "4 4"] | None:
        path = self.poses.get(number)
        if path is None:
            return None
        pose = read_matrix(path)
        return pose @ self._colour_to_pose if np.isfinite(pose).all() else None

    def _intrinsic(self, name: str, shape: tuple[int, ...]) -> Intrinsics:
        k = read_matrix(self.folder / "intrinsic" / f"intrinsic_{name}.txt")
        (fx, _, cx), (_, fy, cy) = k[:2, :3].tolist()
        return Intrinsics(shape[1], shape[0], fx, fy, cx, cy)

    def _extrinsic(self, name: str) -> Float64[np.ndarray, "4 4"]:
        path = self.folder / "intrinsic" / f"extrinsic_{name}.txt"
        matrix = read_matrix(path) if path.is_file() else np.eye(4)
        check_transform(str(path), matrix)
        return matrix


def numbered(folder: Path) -> dict[int, Path]:
    """Return the files of a folder whose names are numbers, by number.

    Raises:
        UserError: if the folder has no such file.
    """
    files = {int(path.stem): path for path in folder.glob("*") if path.stem.isdecimal()}
    if not files:
        raise UserError(
            f"{folder}: got no file with a number as name, expected color/0.jpg, depth/0.png, pose/0.txt and so on"
        )
    return files


def read_matrix(path: Path) -> Float64[np.ndarray, "4 4"]:
    """Read a 4 x 4 matrix, or a 3 x 3 matrix as the upper left block of one.

    Raises:
        UserError: if the file is missing or has other content.
    """
    try:
        numbers = np.array(
            [[float(word) for word in line.split()] for line in path.read_text().splitlines() if line]
        )
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as a matrix ({error})") from error
    if numbers.shape not in ((4, 4), (3, 3)):
        raise UserError(f"{path}: got an array of shape {numbers.shape}, expected 4 x 4 or 3 x 3 numbers")
    matrix = np.eye(4)
    matrix[: len(numbers), : len(numbers)] = numbers
    return matrix

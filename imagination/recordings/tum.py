"""Recordings in folders of the TUM RGB-D benchmark (Sturm et al. 2012): rgb.txt, depth.txt and groundtruth.txt."""

from collections import Counter
from collections.abc import Iterator
from functools import partial
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from imagination.geometry.rgbd import RgbdCamera
from imagination.recordings.images import read_colour, read_depth
from imagination.recordings.recording import BrokenRecordingError, Images, Shot
from imagination.recordings.trajectory import SECOND, Stamp, Trajectory, matrix_of
from imagination.utils.errors import UserError, check_range


class Entry(NamedTuple):
    """Line of a list: the time stamp and the remaining values."""

    stamp: Stamp
    values: list[str]


class TumRecording:
    """Recording in a TUM RGB-D folder, with poses of the colour camera in six degrees of freedom, z up.

    Args:
        path: path of the folder.
        camera: camera of the images, which the benchmark's files do not contain.
        depth_scale: units per metre of the depth images.
        max_difference: largest time difference between a colour image and its depth image, seconds.
        max_gap: largest gap between two poses that is interpolated, seconds.

    Raises:
        UserError: if a list is missing, damaged or empty.
    """

    world = "map"  # the format has no frame id

    def __init__(
        self, path: str, camera: RgbdCamera, depth_scale: float, max_difference: float, max_gap: float
    ) -> None:
        self.folder, self.camera = Path(path), camera
        self.depth_scale = check_range("recording.depth_scale", depth_scale, 1.0, 1e6, "units per metre")
        check_range("recording.max_difference", max_difference, 0.0, 10.0, "s")
        check_range("recording.max_gap", max_gap, 0.0, 3600.0, "s")
        self.skipped: Counter[str] = Counter()
        colour, depth = (self._list(f"{name}.txt") for name in ("rgb", "depth"))
        self.pairs = associate(colour, depth, round(max_difference * SECOND))
        if missing := len(colour) - len(self.pairs):
            self.skipped["colour image without a depth image at its time"] += missing
        self.trajectory = Trajectory(max_gap)
        for entry in self._list("groundtruth.txt"):
            self._add_pose(entry)
        if self.trajectory.repeated:
            self.skipped["repeated pose"] += self.trajectory.repeated

    def shots(self) -> Iterator[Shot]:
        """Iterate over the pairs of images in order of the colour images; see `Recording`."""
        for colour, depth in self.pairs:
            pose = self.trajectory.at(colour.stamp)
            yield Shot(colour.stamp, pose, partial(self._load, colour.values[0], depth.values[0]))

    def _load(self, colour: str, depth: str) -> Images:
        return Images(read_colour(self.folder / colour), read_depth(self.folder / depth, self.depth_scale))

    def _add_pose(self, entry: Entry) -> None:
        try:
            numbers = [float(text) for text in entry.values]
            self.trajectory.add(entry.stamp, matrix_of(numbers[:3], numbers[3:7]))
        except ValueError:  # includes UserError
            self.skipped["invalid pose"] += 1

    def _list(self, name: str) -> list[Entry]:
        """Read the lines of a list in order of time; repeated and earlier time stamps are skipped and counted."""
        path = self.folder / name
        try:
            lines = path.read_text().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(
                f"{path}: cannot be read ({error}); a TUM folder has rgb.txt, depth.txt and groundtruth.txt"
            ) from error
        entries = []
        last = None
        for number, line in enumerate(lines, 1):
            words = line.replace(",", " ").split()
            if not words or words[0].startswith("#"):
                continue
            try:
                stamp = to_stamp(words[0])
            except ValueError as error:
                raise BrokenRecordingError(
                    f"{path}, line {number}: got {line!r}, expected a time stamp first"
                ) from error
            if last is not None and stamp <= last:
                kind = "repeated time stamp" if stamp == last else "time stamp out of order"
                self.skipped[f"{kind} in {name}"] += 1
            elif len(words) > 1:
                entries.append(Entry(stamp, words[1:]))
            last = stamp
        if not entries:
            raise UserError(f"{path}: got no entry, expected lines of a time stamp and its values")
        return entries


def to_stamp(text: str) -> Stamp:
    """Convert seconds as text to nanoseconds without float rounding.

    Raises:
        ValueError: if the text is not a finite number.
    """
    whole, _, part = text.partition(".")
    if not (whole.lstrip("-").isdigit() and (part.isdigit() or not part)):
        seconds = float(text)
        if not isfinite(seconds):
            raise ValueError(f"time {text!r} is not finite")
        return round(seconds * SECOND)
    nanoseconds = int(part[:9].ljust(9, "0"))
    return int(whole) * SECOND + (-nanoseconds if whole.startswith("-") else nanoseconds)


def associate(colour: list[Entry], depth: list[Entry], tolerance: int) -> list[tuple[Entry, Entry]]:
    """Pair entries that are nearest in time, each entry once, closest pairs first (as the benchmark's associate.py)."""
    candidates = []
    first = 0
    depth = sorted(depth)
    for i, entry in enumerate(colour):
        while first and depth[first - 1].stamp >= entry.stamp - tolerance:
            first -= 1  # colour time stamps may decrease
        while first < len(depth) and depth[first].stamp < entry.stamp - tolerance:
            first += 1
        for j in range(first, len(depth)):
            if depth[j].stamp > entry.stamp + tolerance:
                break
            candidates.append((abs(depth[j].stamp - entry.stamp), i, j))
    partner: dict[int, int] = {}
    taken = set()
    for _, i, j in sorted(candidates):
        if i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    return [(colour[i], depth[partner[i]]) for i in sorted(partner)]

"""Preview video of the mapping: colour, depth, projection and prediction next to the map."""

from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image
from PIL.GifImagePlugin import getdata, getheader

from imagination.geometry.grid import Grid
from imagination.geometry.pose import Pose
from imagination.mapping.semantic_map import Maps
from imagination.mapping.semantic_mapper import SemanticMapper, Update
from imagination.mapping.visualization import FREE_COLOUR, OCCUPIED_COLOUR, UNKNOWN_COLOUR, draw_map, paint
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import UserError, check_choice, check_range

Picture = UInt8[np.ndarray, "h w 3"]

PANEL = 240
"""Side of the four small panels, pixels; the map is twice as large."""

FARTHEST = 6.0
"""Depth range of the colour map, metres."""

PATH_COLOUR, ROBOT_COLOUR, TEXT_COLOUR = (40, 90, 220), (220, 30, 30), (20, 20, 20)


class Preview:
    """Viewer that writes preview.mp4 or preview.gif.

    Args:
        format: mp4 or gif.
        rate: frames per second.
        max_frames: largest number of video frames; when it is exceeded, every second frame is dropped and the interval
            between frames doubles.

    Raises:
        UserError: if a value is out of range.
    """

    def __init__(self, format: str = "mp4", rate: float = 10.0, max_frames: int = 300) -> None:
        self.format = check_choice("viewer.format", format, ("gif", "mp4"))
        self.rate = check_range("viewer.rate", rate, 0.1, 60.0, "frames per second")
        self.max_frames = int(check_range("viewer.max_frames", max_frames, 2, 10_000, "frames"))
        self._pictures: list[bytes] = []  # compressed, to bound the memory of long recordings
        self._seen, self._every = 0, 1
        self._path: list[Pose] = []

    def open(self, folder: Path, mapper: SemanticMapper) -> None:
        self._file, self._mapper = folder / f"preview.{self.format}", mapper

    def show(self, stamp: int, update: Update) -> None:
        if self._seen % self._every == 0:
            self._path.append(update.pose)
            colours = self._mapper.spec.colours
            picture = draw_update(update, self._mapper.maps, colours, self._path)
            self._pictures.append(cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
            if len(self._pictures) > self.max_frames:
                self._pictures, self._path, self._every = (
                    self._pictures[::2],
                    self._path[::2],
                    2 * self._every,
                )
        self._seen += 1

    def close(self) -> None:
        """Write the video.

        Raises:
            UserError: if the video cannot be written.
        """
        if not self._pictures:
            return
        # decoded one at a time, to bound memory
        pictures = (Image.open(BytesIO(data)) for data in self._pictures)
        with replacing(self._file) as temporary:
            if self.format == "gif":
                write_gif(temporary, pictures, self.rate)
                return
            written = write_mp4(temporary, pictures, self.rate)
            if written < len(self._pictures):
                raise UserError(
                    f"{self._file}: got {written} of {len(self._pictures)} frames, expected all; free some space, or "
                    "use viewer.format=gif if this OpenCV cannot write MP4"
                )


def write_gif(path: Path, pictures: Iterable[Image.Image], rate: float) -> None:
    """Write a GIF frame by frame; Pillow's save would keep all frames in memory."""
    with open(path, "wb") as file:
        for number, picture in enumerate(pictures):
            indexed = picture.convert("P", palette=Image.Palette.ADAPTIVE)
            if number == 0:
                file.writelines(getheader(indexed, info={"loop": 0, "duration": 1})[0])
            file.writelines(getdata(indexed, duration=round(1000 / rate), include_color_table=True))
        file.write(b";")


def write_mp4(path: Path, pictures: Iterable[Image.Image], rate: float) -> int:
    """Write an MP4 and return the number of frames that can be read back, since OpenCV reports no write errors."""
    writer = cv2.VideoWriter()
    for number, picture in enumerate(pictures):
        if number == 0:
            writer.open(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, picture.size)
        writer.write(np.asarray(picture)[..., ::-1])
    writer.release()
    video, count = cv2.VideoCapture(str(path)), 0
    while video.grab():
        count += 1
    video.release()
    return count


def draw_update(
    update: Update, maps: Maps, colours: Sequence[tuple[int, int, int]], path: Sequence[Pose]
) -> Picture:
    """Draw an update: four small panels and the map with the robot's path.

    Args:
        update: update of the frame.
        maps: map after the update.
        colours: RGB colours of the categories.
        path: poses of the robot so far.
    """
    depth = np.clip(update.depth / FARTHEST, 0, 1)
    shaded = cv2.applyColorMap((255 * (1 - depth)).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    shaded = np.where(update.depth[..., None] > 0, shaded, np.uint8(0))
    projection = np.full((*update.seen.shape, 3), UNKNOWN_COLOUR, np.float32)
    projection[update.seen] = FREE_COLOUR
    projection[update.occupied] = OCCUPIED_COLOUR
    evidence = np.where(update.mask, update.probabilities, np.float32(0))
    imagined = paint(projection, evidence, colours, maps.thresholds)
    panels = [
        _panel(update.rgb, "colour"),
        _panel(shaded, "depth"),
        _panel(projection.astype(np.uint8), "seen and occupied"),
        _panel(imagined, ", ".join(maps.categories)),
    ]
    left = np.vstack([np.hstack(panels[:2]), np.hstack(panels[2:])])
    return np.hstack([left, _with_path(draw_map(maps, colours), maps, path)])


def _panel(image: Picture, title: str) -> UInt8[np.ndarray, "p q 3"]:
    picture = cv2.resize(np.ascontiguousarray(image), (PANEL, PANEL), interpolation=cv2.INTER_NEAREST)
    cv2.rectangle(picture, (0, 0), (PANEL, 16), (255, 255, 255), -1)
    cv2.putText(picture, title, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, TEXT_COLOUR, 1, cv2.LINE_AA)
    return picture


def _with_path(picture: Picture, maps: Maps, path: Sequence[Pose]) -> UInt8[np.ndarray, "p q 3"]:
    """Draw the known part of the map, scaled to the panel, with the robot and its path."""
    side = 2 * PANEL
    known = np.argwhere(maps.known)
    if not len(known):  # no depth so far
        return np.full((side, side, 3), UNKNOWN_COLOUR, np.uint8)
    top, left = known.min(axis=0)
    bottom, right = known.max(axis=0) + 1
    scale = side / max(bottom - top, right - left)
    cut = np.ascontiguousarray(picture[top:bottom, left:right])
    size = max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale))
    shown = cv2.resize(cut, size, interpolation=cv2.INTER_NEAREST)
    canvas = np.full((side, side, 3), UNKNOWN_COLOUR, np.uint8)
    y, x = (side - shown.shape[0]) // 2, (side - shown.shape[1]) // 2
    canvas[y : y + shown.shape[0], x : x + shown.shape[1]] = shown

    def pixel(point: tuple[float, float], grid: Grid) -> tuple[int, int]:
        column = (point[0] - grid.origin[0]) / grid.resolution - left
        row = grid.rows - (point[1] - grid.origin[1]) / grid.resolution - top
        return round(x + column * scale), round(y + row * scale)

    points = np.array([pixel((pose.x, pose.y), maps.grid) for pose in path], np.int32)
    cv2.polylines(canvas, [points.reshape(-1, 1, 2)], False, PATH_COLOUR, 2, cv2.LINE_AA)
    ahead = path[-1].to_world(np.array([0.4, 0.0])).tolist()
    tip = pixel((ahead[0], ahead[1]), maps.grid)
    cv2.arrowedLine(canvas, points[-1].tolist(), tip, ROBOT_COLOUR, 2, cv2.LINE_AA, tipLength=0.4)
    return canvas

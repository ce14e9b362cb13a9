"""What every data set's layout offers, and what is the same in several."""

import hashlib
import json
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from imagination.scenes.source import SPLITS, Split
from imagination.utils.errors import UserError
from imagination_scans.building import GREY, MAX_ID, Building


class Layout(Protocol):
    """How a data set lies on disk. Plain values only inside, so that worker processes receive a copy of it.

    Attributes:
        name: of the data set.
        expected: what a right folder holds.
    """

    name: str
    expected: str

    def buildings(self, folder: Path) -> dict[str, Path]:
        """Each building's folder or main file, by its name.

        Raises:
            UserError: if there are none, with what a right folder looks like.
        """

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        """The official split of each building; those without one are left out."""

    def files(self, building: Path) -> list[Path]:
        """What a building is read from, for fingerprints."""

    def read(self, building: Path) -> Building:
        """Read one.

        Raises:
            UserError: if a file is missing or malformed, with its name, the line and what was expected.
        """


def split_lists(folder: Path, pattern: str) -> dict[str, Split]:
    """Names in text files, one a line, such as scenes_train.txt; empty if there is none.

    Raises:
        UserError: if one cannot be read.
    """
    found: dict[str, Split] = {}
    for split in SPLITS:
        path = folder / pattern.format(split=split)
        if path.is_file():
            try:
                lines = path.read_text().splitlines()
            except (OSError, UnicodeDecodeError) as error:
                raise UserError(f"{path}: cannot be read ({error}), expected a name a line") from error
            for line in lines:
                if line.strip():
                    found[line.strip()] = split
    return found


def lot(name: str) -> float:
    """A number in [0, 1) that a building's own name decides: where it falls, more buildings move no other."""
    return hashlib.sha256(name.encode()).digest()[0] / 256


def check_id(id: int, taken: Container[int], least: int = 0) -> int:
    """An object's id as a file has it.

    Raises:
        ValueError: if it is out of range, as ids that mean no object are, or another object has it.
    """
    if not least <= id < MAX_ID:
        raise ValueError(f"the id {id} is not in [{least}, {MAX_ID})")
    if id in taken:
        raise ValueError(f"the id {id} occurs twice")
    return id


def first_of(folder: Path, *names: str) -> Path:
    """The first of several files that exists.

    Raises:
        UserError: if none does.
    """
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise UserError(f"{folder}: has none of {', '.join(names)}, expected one of them")


def read_ply(path: Path) -> Any:
    """A PLY file, memory-mapped where its faces all are triangles, or quadrilaterals, else read.

    Raises:
        UserError: if the extra is not installed or the file is malformed.
    """
    try:
        from plyfile import PlyData, PlyElementParseError, PlyHeaderParseError
    except ImportError as error:
        raise UserError("scanned buildings need plyfile: pip install 'imagination[scans]'") from error
    try:
        _check_counts(path)
        for corners in (3, 4):
            known = {"face": {"vertex_indices": corners, "vertex_index": corners}}
            try:
                return PlyData.read(path, mmap="c", known_list_len=known)
            except PlyElementParseError:
                continue
        return PlyData.read(path)
    except PlyHeaderParseError as error:
        raise UserError(f"{path}: its header is broken: {error}, expected PLY") from error
    except (PlyElementParseError, ValueError, OverflowError, MemoryError, OSError) as error:
        raise UserError(f"{path}: cannot be read as PLY: {error}") from error


def _check_counts(path: Path) -> None:
    """Refuse elements that cannot fit into the file before memory is set aside for them: a value takes a byte or more.

    Raises:
        UserError: with the element's line.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        count, values, announced = 0, 0, 0
        for number, line in enumerate(iter(lambda: file.readline(4096), b""), start=1):
            words = line.split()
            if len(line) == 4096 and not line.endswith(b"\n"):
                raise UserError(f"{path}, line {number}: has more than 4096 bytes, expected PLY's header")
            if words[:1] == [b"element"] and len(words) == 3:
                if not words[2].isdigit():
                    raise UserError(
                        f"{path}, line {number}: got {words[2].decode('latin-1')!r} elements, expected a whole number"
                    )
                count, values, announced = int(words[2].lstrip(b"0")[:18] or 0), 0, number
            elif words[:1] == [b"property"]:
                values += 1
            elif words[:1] not in ([b"ply"], [b"format"], [b"comment"], [b"obj_info"], []):
                return
            if count * max(values, 1) > size:
                raise UserError(
                    f"{path}, line {announced}: announces {count} elements of {max(values, 1)} or more bytes, but the "
                    f"file has {size} bytes; it is truncated or damaged"
                )


def ply_columns(
    ply: Any, path: Path, element: str, *choices: Sequence[str], kinds: str = "iuf", lists: bool = False
) -> list[np.ndarray]:
    """Columns of an element, each by the first of its possible names that is there.

    Args:
        ply, path: the file read, and its name.
        element: "vertex" or "face".
        choices: possible names of each column.
        kinds: of numbers that are allowed: i and u are integers, f is not.
        lists: the columns are lists of such numbers.

    Raises:
        UserError: if one is missing or of another kind.
    """
    if element not in ply:
        raise UserError(f"{path}: has no element {element!r}")
    data = ply[element].data
    columns = []
    for names in choices:
        name = next((name for name in names if name in data.dtype.names), None)
        if name is None:
            raise UserError(
                f"{path}: its {element} has no {' or '.join(names)} (it has {', '.join(data.dtype.names)})"
            )
        found = ply[element].ply_property(name)
        kind = np.dtype(found.val_dtype).kind
        if hasattr(found, "len_dtype") != lists or kind not in kinds:
            wanted = f"{'lists of ' if lists else ''}{'numbers' if 'f' in kinds else 'integers'}"
            raise UserError(f"{path}: its {element} has '{found}', expected {wanted}")
        columns.append(data[name])
    return columns


def ply_mesh(ply: Any, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, 3), polygons' triangles (m, 3), which polygon each triangle is of (m,), colour of vertices (n, 3).

    Raises:
        UserError: if columns are missing or faces refer to vertices that do not exist.
    """
    x, y, z = ply_columns(ply, path, "vertex", ["x"], ["y"], ["z"])
    vertices = np.stack([x, y, z], axis=-1).astype(np.float32)
    indices = ["vertex_indices", "vertex_index"]
    (corners,) = ply_columns(ply, path, "face", indices, kinds="iu", lists=True)
    if corners.dtype == object:
        sizes = np.array([len(polygon) for polygon in corners])
        if len(sizes) and sizes.min() < 3:
            raise UserError(
                f"{path}: face {int(sizes.argmin())} has {sizes.min()} corners, expected 3 or more"
            )
        fans = [[(p[0], p[k], p[k + 1]) for k in range(1, len(p) - 1)] for p in corners]
        faces = np.array([fan for polygon in fans for fan in polygon], np.int32).reshape(-1, 3)
        owner = np.repeat(np.arange(len(corners)), np.maximum(sizes - 2, 0) if len(sizes) else 0)
    else:
        count = corners.shape[1]
        owner = np.repeat(np.arange(len(corners)), count - 2)
        fans_ = [corners[:, [0, k, k + 1]] for k in range(1, count - 1)]
        faces = np.stack(fans_, axis=1).reshape(-1, 3).astype(np.int32)
    if len(faces) == 0:
        raise UserError(f"{path}: its mesh has no faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(
            f"{path}: faces refer to vertices {faces.min()} to {faces.max()}, expected 0 to {len(vertices) - 1}"
        )
    if not np.isfinite(vertices).all():
        raise UserError(f"{path}: has vertices that are not finite")
    rgb = np.full((len(vertices), 3), GREY, np.uint8)
    if {"red", "green", "blue"} <= set(ply["vertex"].data.dtype.names):
        channels = ply_columns(ply, path, "vertex", ["red"], ["green"], ["blue"], kinds="iu")
        rgb = np.stack(channels, axis=-1).astype(np.uint8)
    return vertices, faces, owner, rgb


def face_colours(rgb: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mean colour of each face's corners."""
    total = sum(rgb[faces[:, k]].astype(np.uint16) for k in range(3))
    return np.asarray(total // 3, np.uint8)


def read_json(path: Path) -> Any:
    """A JSON file.

    Raises:
        UserError: if it is missing or malformed, with the line.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError as error:
        raise UserError(f"{path}: there is no such file") from error
    except ValueError as error:  # of wrong syntax, wrong encoding, numbers of thousands of digits
        raise UserError(f"{path}: is no JSON: {error}") from error
    except RecursionError as error:
        raise UserError(f"{path}: is nested too deeply for its kind of file") from error

"""Interface of the layouts of data sets, and readers shared by several of them."""

import hashlib
import json
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from imagination.scenes.source import SPLITS, Split
from imagination.utils.errors import UserError, require_extra
from imagination_scans.building import GREY, MAX_ID, Building


class Layout(Protocol):
    """Layout of a data set on disk. It holds plain values only, so that worker processes receive a copy.

    Attributes:
        name: name of the data set.
        expected: description of a valid folder, for messages.
    """

    name: str
    expected: str

    def buildings(self, folder: Path) -> dict[str, Path]:
        """Return the folder or main file of each building by its name.

        Raises:
            UserError: if there are none; the message describes a valid folder.
        """

    def splits(self, folder: Path, names: Sequence[str]) -> Mapping[str, Split]:
        """Return the official split of each building that has one."""

    def files(self, building: Path) -> list[Path]:
        """Return the files of a building, for fingerprints."""

    def read(self, building: Path) -> Building:
        """Read a building.

        Raises:
            UserError: if a file is missing or malformed; the message names the file and line.
        """


def split_lists(folder: Path, pattern: str) -> dict[str, Split]:
    """Read the split of each name from text files with a name per line, such as scenes_train.txt.

    Raises:
        UserError: if a file cannot be read.
    """
    split_of: dict[str, Split] = {}
    for split in SPLITS:
        path = folder / pattern.format(split=split)
        if path.is_file():
            try:
                lines = path.read_text().splitlines()
            except (OSError, UnicodeDecodeError) as error:
                raise UserError(f"{path}: cannot be read ({error}), expected a name per line") from error
            for line in lines:
                if line.strip():
                    split_of[line.strip()] = split
    return split_of


def hash_fraction(name: str) -> float:
    """Return a number in [0, 1) derived from a name, so that splits do not depend on the other buildings."""
    return hashlib.sha256(name.encode()).digest()[0] / 256


def check_id(id: int, taken: Container[int], minimum: int = 0) -> int:
    """Return the id of an object in a file after checking it.

    Raises:
        ValueError: if the id is out of range, or taken.
    """
    if not minimum <= id < MAX_ID:
        raise ValueError(f"the id {id} is not in [{minimum}, {MAX_ID})")
    if id in taken:
        raise ValueError(f"the id {id} occurs twice")
    return id


def first_existing(folder: Path, *names: str) -> Path:
    """Return the first of several files that exists.

    Raises:
        UserError: if no file exists.
    """
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise UserError(f"{folder}: has none of {', '.join(names)}, expected one of them")


def read_ply(path: Path) -> Any:
    """Read a PLY file, memory-mapped if all faces are triangles or all are quadrilaterals.

    Raises:
        UserError: if plyfile is not installed or the file is malformed.
    """
    require_extra("plyfile", "scans")
    from plyfile import PlyData, PlyElementParseError, PlyHeaderParseError

    try:
        _check_counts(path)
        for corners in (3, 4):
            list_lengths = {"face": {"vertex_indices": corners, "vertex_index": corners}}
            try:
                return PlyData.read(path, mmap="c", known_list_len=list_lengths)
            except PlyElementParseError:
                continue
        return PlyData.read(path)
    except PlyHeaderParseError as error:
        raise UserError(f"{path}: invalid header: {error}, expected PLY") from error
    except (PlyElementParseError, ValueError, OverflowError, MemoryError, OSError) as error:
        raise UserError(f"{path}: cannot be read as PLY: {error}") from error


def _check_counts(path: Path) -> None:
    """Check that the announced elements fit into the file (at least a byte per value) before memory is allocated.

    Raises:
        UserError: if they do not fit; the message names the line.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        count, values, element_line = 0, 0, 0
        for number, line in enumerate(iter(lambda: file.readline(4096), b""), start=1):
            words = line.split()
            if len(line) == 4096 and not line.endswith(b"\n"):
                raise UserError(f"{path}, line {number}: got more than 4096 bytes, expected a PLY header")
            if words[:1] == [b"element"] and len(words) == 3:
                if not words[2].isdigit():
                    raise UserError(
                        f"{path}, line {number}: got {words[2].decode('latin-1')!r} elements, expected a whole number"
                    )
                count, values, element_line = int(words[2].lstrip(b"0")[:18] or 0), 0, number
            elif words[:1] == [b"property"]:
                values += 1
            elif words[:1] not in ([b"ply"], [b"format"], [b"comment"], [b"obj_info"], []):
                return
            if count * max(values, 1) > size:
                raise UserError(
                    f"{path}, line {element_line}: announces {count} elements of {max(values, 1)} or more bytes, but "
                    f"the file has {size} bytes; it is truncated or damaged"
                )


def ply_columns(
    ply: Any, path: Path, element: str, *choices: Sequence[str], kinds: str = "iuf", lists: bool = False
) -> list[np.ndarray]:
    """Return columns of an element, each under the first of its possible names that exists.

    Args:
        ply: content of the file.
        path: path of the file, for messages.
        element: "vertex" or "face".
        choices: possible names of each column.
        kinds: allowed NumPy kinds of the numbers: i and u for integers, f for floats.
        lists: whether the columns are lists of numbers.

    Raises:
        UserError: if a column is missing or of another type.
    """
    if element not in ply:
        raise UserError(f"{path}: element {element!r} is missing")
    data = ply[element].data
    columns = []
    for names in choices:
        name = next((name for name in names if name in data.dtype.names), None)
        if name is None:
            raise UserError(
                f"{path}: {element} has no {' or '.join(names)} (found {', '.join(data.dtype.names)})"
            )
        column = ply[element].ply_property(name)
        kind = np.dtype(column.val_dtype).kind
        if hasattr(column, "len_dtype") != lists or kind not in kinds:
            expected = f"{'lists of ' if lists else ''}{'numbers' if 'f' in kinds else 'integers'}"
            raise UserError(f"{path}: {element}: got '{column}', expected {expected}")
        columns.append(data[name])
    return columns


def ply_mesh(ply: Any, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices (n, 3), triangles (m, 3), the polygon of each triangle (m,), and vertex colours (n, 3).

    Raises:
        UserError: if columns are missing or invalid.
    """
    x, y, z = ply_columns(ply, path, "vertex", ["x"], ["y"], ["z"])
    vertices = np.stack([x, y, z], axis=-1).astype(np.float32)
    indices = ["vertex_indices", "vertex_index"]
    (corners,) = ply_columns(ply, path, "face", indices, kinds="iu", lists=True)
    if corners.dtype == object:
        sizes = np.array([len(polygon) for polygon in corners])
        if len(sizes) and sizes.min() < 3:
            raise UserError(
                f"{path}: face {int(sizes.argmin())}: got {sizes.min()} corners, expected at least 3"
            )
        fans = [[(p[0], p[k], p[k + 1]) for k in range(1, len(p) - 1)] for p in corners]
        faces = np.array([fan for polygon in fans for fan in polygon], np.int32).reshape(-1, 3)
        owner = np.repeat(np.arange(len(corners)), np.maximum(sizes - 2, 0) if len(sizes) else 0)
    else:
        count = corners.shape[1]
        owner = np.repeat(np.arange(len(corners)), count - 2)
        columns = [corners[:, [0, k, k + 1]] for k in range(1, count - 1)]
        faces = np.stack(columns, axis=1).reshape(-1, 3).astype(np.int32)
    if len(faces) == 0:
        raise UserError(f"{path}: the mesh has no faces")
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
    """Return the mean colour of the corners of each face."""
    total = sum(rgb[faces[:, k]].astype(np.uint16) for k in range(3))
    return np.asarray(total // 3, np.uint8)


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        UserError: if the file is missing or malformed; the message names the line.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError as error:
        raise UserError(f"{path}: does not exist") from error
    except ValueError as error:  # invalid syntax or encoding, or a number of thousands of digits
        raise UserError(f"{path}: is not valid JSON: {error}") from error
    except RecursionError as error:
        raise UserError(f"{path}: is nested too deeply") from error

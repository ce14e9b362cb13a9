"""Readers and writers of map files: ROS' map_server format, semantic.npz, a coloured picture and GeoJSON.

`map.yaml` and `map.pgm` hold occupancy in nav2's format, `<category>.yaml` and `.pgm` the probability of a category in
percent (mode raw). `negate`, thresholds and modes have the meaning of nav2's map_server (navigation2,
nav2_map_server/src/map_io.cpp).
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml
from jaxtyping import Bool, Float64

from imagination.geometry.grid import MAX_CELLS, Grid
from imagination.mapping.semantic_map import FREE, OCCUPIED, UNKNOWN, Layer, MapObject, Maps
from imagination.mapping.visualization import draw_map
from imagination.utils.atomic_io import replacing, write_npz, write_text
from imagination.utils.errors import UserError, check_choice, check_range
from imagination.utils.image_decoding import decode
from imagination.utils.tabular import read_yaml

VERSION = 2
"""Format version of semantic.npz."""

SHADES = {FREE: 254, UNKNOWN: 205, OCCUPIED: 0}
"""Grey values of occupancy that nav2's map saver writes."""

THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}
"""Occupancy thresholds between which a cell is unknown, as is grey value 205."""

SEMANTIC, PICTURE, OBJECTS = "semantic.npz", "map.png", "objects.geojson"


class LoadedLayer(NamedTuple):
    """Map in map_server format: the grid and the occupancy layer that nav2 would load."""

    grid: Grid
    layer: Layer


def save_maps(folder: Path, maps: Maps, colours: Sequence[tuple[int, int, int]]) -> None:
    """Write all map files into a folder, each of them atomically.

    Args:
        folder: output folder, created if it does not exist.
        maps: semantic map.
        colours: RGB colours of the categories.

    Raises:
        UserError: if the disk is full or the folder is not writable.
    """
    save_layer(folder / "map.yaml", maps.grid, maps.occupancy_layer(), "trinary")
    for category in maps.categories:
        save_layer(folder / f"{category}.yaml", maps.grid, maps.category_layer(category), "raw")
    save_semantic(folder / SEMANTIC, maps)
    write_text(folder / OBJECTS, json.dumps(to_geojson(maps.objects(), maps.frame), indent=1))
    picture = draw_map(maps, colours)
    with replacing(folder / PICTURE) as temporary:
        temporary.write_bytes(_encoded(".png", picture[..., ::-1]))


def save_layer(path: Path, grid: Grid, layer: Layer, mode: str) -> None:
    """Write one layer in map_server format: the .yaml file `path` and a .pgm image in the same folder.

    Args:
        path: path of the YAML file.
        grid: grid of the layer.
        layer: percent, -1 for unknown cells.
        mode: trinary (only free, occupied and unknown) or raw (percent).
    """
    check_choice("mode", mode, ("raw", "trinary"))
    if mode == "raw":
        image = layer.view(np.uint8)  # -1 becomes 255 (unknown)
    else:
        image = np.select(
            [layer == OCCUPIED, layer == FREE], [SHADES[OCCUPIED], SHADES[FREE]], SHADES[UNKNOWN]
        )
    with replacing(path.with_suffix(".pgm")) as temporary:
        temporary.write_bytes(_encoded(".pgm", image.astype(np.uint8)))
    text = {
        "image": path.with_suffix(".pgm").name,
        "mode": mode,
        "resolution": float(grid.resolution),
        "origin": [float(grid.origin[0]), float(grid.origin[1]), 0.0],
        "negate": 0,
        **THRESHOLDS,
    }
    write_text(path, yaml.safe_dump(text, sort_keys=False))


def load_layer(path: str | Path) -> LoadedLayer:
    """Read a map in map_server format with nav2's rules, also one of another robot.

    Raises:
        UserError: if a file is missing or damaged, a value is missing or out of range, or the origin is rotated.
    """
    path = Path(path)
    values = read_yaml(path, "the keys of map_server's format")
    mode = check_choice(f"{path}: mode", str(values.get("mode", "trinary")), ("raw", "scale", "trinary"))
    try:
        image_path, negate = path.parent / str(values["image"]), bool(int(values["negate"]))
        resolution = float(values["resolution"])
        low, high = float(values["free_thresh"]), float(values["occupied_thresh"])
        x, y, yaw = (float(value) for value in values["origin"])
    except KeyError as error:
        raise UserError(
            f"{path}: key {error} is missing, expected image, resolution, origin, negate and both thresholds"
        ) from error
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{path}: a value cannot be read ({error})") from error
    check_range(f"{path}: resolution", resolution, 0.005, 1.0, "m")
    if not 0 <= low < high <= 1:
        raise UserError(
            f"{path}: got free_thresh {low} and occupied_thresh {high}, expected 0 <= free < occupied <= 1"
        )
    if not np.isfinite([x, y]).all() or abs(yaw) > 1e-9:
        raise UserError(
            f"{path}: got origin [{x}, {y}, {yaw}], expected finite metres and no rotation; rotate the image instead"
        )
    shade, opaque = _read_shades(image_path, mode)
    rows, columns = shade.shape
    return LoadedLayer(
        Grid(resolution, rows, columns, (x, y)), _interpret(shade, opaque, mode, negate, low, high)
    )


def load_maps(folder: str | Path) -> Maps:
    """Read the semantic map of a folder from its semantic.npz.

    Raises:
        UserError: if the file is missing, damaged or of another version.
    """
    path = Path(folder) / SEMANTIC
    try:
        with np.load(path, allow_pickle=False) as file:
            if int(file["version"]) != VERSION:
                raise UserError(f"{path}: got version {int(file['version'])}, expected {VERSION}")
            probabilities = file["probabilities"]
            origin = float(file["origin"][0]), float(file["origin"][1])
            rows, columns = probabilities.shape[1:]
            return Maps(
                Grid(float(file["resolution"]), rows, columns, origin),
                str(file["frame"]),
                tuple(map(str, file["categories"])),
                tuple(map(float, file["thresholds"])),
                probabilities,
                file["written"],
                file["occupancy"],
                file["known"],
            )
    except FileNotFoundError as error:
        raise UserError(f"{path}: there is no such file") from error
    except UserError:
        raise
    except Exception as error:  # zip, zlib and NumPy raise many types on a damaged file
        raise UserError(f"{path}: cannot be read ({error}); save the map again") from error


def save_semantic(path: Path, maps: Maps) -> None:
    """Write all layers with frame, origin, resolution, categories, thresholds and format version."""
    arrays = {
        "version": VERSION,
        "frame": maps.frame,
        "origin": np.array(maps.grid.origin),
        "resolution": maps.grid.resolution,
        "categories": np.array(maps.categories),
        "thresholds": np.array(maps.thresholds),
        "probabilities": maps.probabilities,
        "written": maps.written,
        "occupancy": maps.occupancy,
        "known": maps.known,
    }
    write_npz(path, arrays)


def to_geojson(objects: Sequence[MapObject], frame: str) -> dict[str, Any]:
    """Return objects as a GeoJSON FeatureCollection (RFC 7946) in metres of the map's frame instead of degrees."""

    def ring(loop: np.ndarray) -> list[list[float]]:
        return [[round(x, 4), round(y, 4)] for x, y in [*loop.tolist(), loop[0].tolist()]]

    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [ring(obj.outline), *map(ring, obj.holes)]},
            "properties": {
                "category": obj.category,
                "confidence": round(obj.confidence, 4),
                "area": round(obj.area, 4),
            },
        }
        for obj in objects
    ]
    return {"type": "FeatureCollection", "frame": frame, "units": "m", "features": features}


def load_objects(path: str | Path) -> list[MapObject]:
    """Read objects.geojson.

    Raises:
        UserError: if the file is missing or damaged.
    """
    try:
        objects = []
        for feature in json.loads(Path(path).read_text())["features"]:
            outline, *holes = (np.array(ring[:-1]) for ring in feature["geometry"]["coordinates"])
            values = feature["properties"]
            objects.append(
                MapObject(values["category"], outline, holes, values["confidence"], values["area"])
            )
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: not a GeoJSON file of objects ({error!r}); save the map again") from error
    return objects


def resample_layer(loaded: LoadedLayer, grid: Grid) -> Layer:
    """Resample a layer to a grid of another resolution or origin; cells outside the layer are unknown.

    A cell takes the value at its centre. A cell that contains the centre of an occupied cell is occupied, so that thin
    walls are not lost between the centres of coarser cells.
    """
    rows, columns = np.indices(grid.shape)
    source = loaded.grid.to_cells(grid.to_points(np.stack([rows, columns], axis=-1)))
    inside = loaded.grid.inside(source)
    layer = np.full(grid.shape, UNKNOWN, np.int8)
    layer[inside] = loaded.layer[tuple(source[inside].T)]
    occupied = grid.to_cells(loaded.grid.to_points(np.argwhere(loaded.layer == OCCUPIED)))
    layer[tuple(occupied[grid.inside(occupied)].T)] = OCCUPIED
    return layer


def _encoded(suffix: str, image: np.ndarray) -> bytes:
    success, data = cv2.imencode(suffix, image)
    assert success, "OpenCV writes these formats"
    return data.tobytes()


def _read_shades(path: Path, mode: str) -> tuple[Float64[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Read the brightness of each pixel, 0 to 1, and the mask of opaque pixels."""
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # the path in a map file may be invalid, e.g. contain null bytes
        raise UserError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error
    try:
        image = decode(data, cv2.IMREAD_UNCHANGED, MAX_CELLS)
    except UserError as error:
        raise UserError(f"{path}: {error}; save the map again as PGM, PNG or BMP") from error
    if image.dtype not in (np.uint8, np.uint16):
        raise UserError(f"{path}: got pixels of {image.dtype}, expected 8 or 16 bits")
    try:
        full = float(_white(data, image.dtype))
    except ValueError as error:  # includes UserError
        raise UserError(f"{path}: {error}") from error
    channels = image.reshape(*image.shape[:2], -1)
    colour = channels[..., :3] if channels.shape[2] >= 3 else channels[..., :1]
    opaque = channels[..., 3] == full if channels.shape[2] == 4 else np.ones(image.shape[:2], np.bool_)
    if mode == "trinary" and channels.shape[2] == 4:
        colour = channels  # nav2 averages the opacity with the colours in this mode
    return np.minimum(colour.mean(axis=2) / full, 1), opaque


def _white(data: bytes, dtype: np.dtype[Any]) -> int:
    """Return the value of white: PGM and PPM headers hold it, and OpenCV rescales only ASCII files of 8 bits."""
    words = re.sub(rb"#[^\n]*", b" ", data[:4096]).split(maxsplit=4)
    if words[0] in (b"P5", b"P6") or (words[0] in (b"P2", b"P3") and dtype == np.uint16):
        if len(words) < 4:
            raise UserError("header: got comments of more than 4096 bytes; shorten them")
        return int(words[3])
    return int(np.iinfo(dtype).max)


def _interpret(
    shade: np.ndarray, opaque: np.ndarray, mode: str, negate: bool, low: float, high: float
) -> Layer:
    """Convert brightness to occupancy with nav2's rules."""
    if mode == "raw":
        value = np.rint(shade * 255)
        return np.where(value <= OCCUPIED, value, UNKNOWN).astype(np.int8)
    occupied = shade if negate else 1 - shade
    if mode == "trinary":
        undecided: Any = UNKNOWN
    else:
        undecided = np.where(opaque, np.rint((occupied - low) / (high - low) * 100), UNKNOWN)
    known = opaque | (mode == "trinary")
    layer = np.select([known & (occupied > high), known & (occupied < low)], [OCCUPIED, FREE], undecided)
    return layer.astype(np.int8)

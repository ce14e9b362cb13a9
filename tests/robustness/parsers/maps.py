"""Parsers of map files."""

from pathlib import Path

import cv2
import numpy as np

from imagination.geometry.grid import Grid
from imagination.mapping import map_io
from imagination.mapping.semantic_map import Maps
from tests.robustness.parsers.parser import Parser, resealed, temporary_folder, with_file_replaced


def save(folder: Path) -> None:
    """Save a map of one object."""
    probabilities = np.zeros((1, 20, 20), np.float32)
    probabilities[:, 4:12, 5:9] = 0.75
    known = np.ones((20, 20), np.bool_)
    grid = Grid(0.05, 20, 20, (0.0, 0.0))
    maps = Maps(grid, "map", ("chair",), (0.5,), probabilities, known[None], probabilities[0], known)
    map_io.save_maps(folder, maps, [(200, 0, 0)])


def load_layer(folder: Path) -> object:
    return map_io.load_layer(folder / "map.yaml")


def load_objects(folder: Path) -> object:
    return map_io.load_objects(folder / map_io.OBJECTS)


def images() -> list[bytes]:
    """Return images of a map in other formats of map_server."""
    shades = np.full((20, 20), 254, np.uint8)
    shades[4:12, 5:9] = 0
    seen = np.where(shades > 0, 255, 0).astype(np.uint8)
    kinds = (".png", shades), (".bmp", shades), (".png", cv2.merge([shades, shades, shades, seen]))
    return [cv2.imencode(suffix, image)[1].tobytes() for suffix, image in kinds]


MAP = temporary_folder(save)

PARSERS = [
    Parser("map-map.yaml", *with_file_replaced(MAP, "map.yaml", load_layer)),
    Parser("map-map.pgm", *with_file_replaced(MAP, "map.pgm", load_layer)),
    Parser("map-image", with_file_replaced(MAP, "map.pgm", load_layer)[0], images),
    Parser("map-semantic.npz", *with_file_replaced(MAP, map_io.SEMANTIC, map_io.load_maps)),
    Parser("map-semantic-resealed", *resealed(*with_file_replaced(MAP, map_io.SEMANTIC, map_io.load_maps))),
    Parser("map-objects.geojson", *with_file_replaced(MAP, map_io.OBJECTS, load_objects)),
]

"""Map files, checked with an independent reader: PyYAML and Pillow with nav2's rules (nav2_map_server, map_io.cpp)."""

import json
import struct
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from imagination.geometry.grid import Grid
from imagination.mapping import map_io
from imagination.mapping.map_io import LoadedLayer
from imagination.mapping.semantic_map import FREE, Maps
from imagination.utils.errors import UserError

GRID = Grid(0.05, 40, 60, (-1.25, 2.5))


def some_maps(seed: int = 0) -> Maps:
    rng = np.random.default_rng(seed)
    coarse = rng.random((2, 8, 12), dtype=np.float32)
    probabilities = np.kron(coarse, np.ones((1, 5, 5), np.float32)).astype(np.float32)
    written = rng.random((2, *GRID.shape)) < 0.8
    known = rng.random(GRID.shape) < 0.8
    occupancy = rng.random(GRID.shape, dtype=np.float32)
    return Maps(
        GRID, "odom", ("chair", "bed"), (0.5, 0.8), np.where(written, probabilities, np.float32(0)), written,
        np.where(known, occupancy, np.float32(0)), known,
    )  # fmt: skip


def nav2(path: Path) -> tuple[np.ndarray, list[float], float]:
    """Data as nav2 publishes them (first row lowest), origin and resolution."""
    meta = yaml.safe_load(path.read_text())
    pixels = np.array(Image.open(path.parent / meta["image"]), np.float64)
    shade = pixels / 255
    occupied = shade if meta["negate"] else 1 - shade
    data = np.full(shape=pixels.shape, fill_value=-1, dtype=int)
    for index, value in np.ndenumerate(occupied):
        if meta["mode"] == "trinary":
            if value > meta["occupied_thresh"]:
                data[index] = 100
            elif value < meta["free_thresh"]:
                data[index] = 0
        elif meta["mode"] == "scale":
            low, high = meta["free_thresh"], meta["occupied_thresh"]
            between = round((value - low) / (high - low) * 100)
            data[index] = 100 if value > high else 0 if value < low else between
        elif meta["mode"] == "raw":
            raw = round(shade[index] * 255)
            data[index] = raw if raw <= 100 else -1
    return data[::-1], meta["origin"], meta["resolution"]


def test_what_nav2_would_read(tmp_path: Path) -> None:
    maps = some_maps()
    map_io.save_maps(tmp_path, maps, [(200, 0, 0), (0, 0, 200)])
    for name, layer in (("map", maps.occupancy_layer()), ("bed", maps.category_layer("bed"))):
        data, origin, resolution = nav2(tmp_path / f"{name}.yaml")
        assert (origin, resolution) == ([-1.25, 2.5, 0.0], 0.05)
        assert (data == layer[::-1]).all()
        assert set(np.unique(data)) == ({-1, 0, 100} if name == "map" else set(np.unique(layer)))
        loaded = map_io.load_layer(tmp_path / f"{name}.yaml")
        assert loaded.grid == GRID and (loaded.layer == layer).all()
    # by hand: the cell in the lower-left corner is nav2's first
    assert nav2(tmp_path / "bed.yaml")[0][0, 0] == (
        round(100 * float(maps.probabilities[1, -1, 0])) if maps.written[1, -1, 0] else -1
    )


def test_saved_maps_come_back(tmp_path: Path) -> None:
    maps = some_maps()
    map_io.save_maps(tmp_path / "new" / "folder", maps, [(200, 0, 0), (0, 0, 200)])
    again = map_io.load_maps(tmp_path / "new" / "folder")
    assert (again.grid, again.frame, again.categories) == (GRID, "odom", ("chair", "bed"))
    assert again.thresholds == (0.5, 0.8)
    for name in ("probabilities", "written", "occupancy", "known"):
        np.testing.assert_array_equal(getattr(again, name), getattr(maps, name))
    objects = map_io.load_objects(tmp_path / "new" / "folder" / "objects.geojson")
    wanted = maps.objects()
    assert len(objects) == len(wanted) > 3
    for one, other in zip(objects, wanted, strict=True):
        np.testing.assert_allclose(one.outline, other.outline, atol=1e-4)
        assert (one.category, len(one.holes)) == (other.category, len(other.holes))
        assert abs(one.confidence - other.confidence) < 1e-4
    picture = np.array(Image.open(tmp_path / "new" / "folder" / "map.png"))
    assert picture.shape == (40, 60, 3)
    chair, bed = maps.probabilities
    sure = (chair > 0.5) & (bed == 0)
    assert (picture[sure][:, 0] > picture[sure][:, 2] + 60).all()
    alone = (chair == 0) & (maps.occupancy_layer() == FREE)
    full, weak = alone & (bed >= 0.8), alone & (bed > 0.5) & (bed < 0.8)  # in full from its own threshold on
    assert picture[full][:, 0].max() + 60 < picture[weak][:, 0].min()


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", [0, 1])
def test_maps_of_other_robots(tmp_path: Path, mode: str, negate: int) -> None:
    """Grey values of every kind, thresholds that nobody else uses."""
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (30, 50), dtype=np.uint8)
    with open(tmp_path / "m.pgm", "wb") as file:
        file.write(b"P5\n# CREATOR: map_saver.cpp 0.050 m/pix\n50 30\n255\n" + image.tobytes())
    meta = {"image": "m.pgm", "resolution": 0.05, "origin": [-10.0, -5.5, 0.0], "negate": negate}
    meta |= {"occupied_thresh": 0.73, "free_thresh": 0.11, "mode": mode}
    (tmp_path / "m.yaml").write_text(yaml.safe_dump(meta))
    loaded = map_io.load_layer(tmp_path / "m.yaml")
    data, origin, _ = nav2(tmp_path / "m.yaml")
    assert (loaded.layer[::-1] == data).all()
    assert loaded.grid == Grid(0.05, 30, 50, (-10.0, -5.5)) and origin == [-10.0, -5.5, 0.0]


def test_images_with_colours_opacity_and_16_bits(tmp_path: Path) -> None:
    def load(image: Image.Image, mode: str) -> np.ndarray:
        image.save(tmp_path / "m.png")
        text = f"image: m.png\nmode: {mode}\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: false\n"
        (tmp_path / "m.yaml").write_text(text + "occupied_thresh: 0.65\nfree_thresh: 0.25\n")
        return map_io.load_layer(tmp_path / "m.yaml").layer

    grey = np.array([[0, 40, 128, 254, 255]], np.uint8)
    colours = np.stack([grey, grey, grey], axis=-1)
    assert load(Image.fromarray(colours), "trinary").tolist() == [[100, 100, -1, 0, 0]]
    sixteen = Image.fromarray(grey.astype(np.uint16) * 257)
    assert load(sixteen, "trinary").tolist() == [[100, 100, -1, 0, 0]]
    clear = np.concatenate([colours, np.array([[[255], [255], [255], [0], [255]]], np.uint8)], axis=-1)
    assert load(Image.fromarray(clear), "scale").tolist() == [[100, 100, 62, -1, 0]]


@pytest.mark.parametrize(
    ("image", "layer"),
    [
        (b"P5\n# white is 100\n3 1\n100\n" + bytes([0, 50, 100]), [100, -1, 0]),
        (b"P5 3 1 1000\n" + np.array([0, 500, 1000], ">u2").tobytes(), [100, -1, 0]),
        (b"P2\n3 1\n100\n0 50 100\n", [100, -1, 0]),
        (b"P2\n3 1\n1000\n0 500 1000\n", [100, -1, 0]),
        (b"P6\n2 1\n100\n" + bytes([0, 0, 0, 100, 100, 100]), [100, 0]),
    ],
)
def test_white_is_what_the_image_says(tmp_path: Path, image: bytes, layer: list[int]) -> None:
    """Largest values other than 255 and 65535 (https://netpbm.sourceforge.net/doc/pgm.html)."""
    (tmp_path / "m.pgm").write_bytes(image)
    text = "image: m.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\n"
    (tmp_path / "m.yaml").write_text(text + "occupied_thresh: 0.65\nfree_thresh: 0.196\n")
    assert map_io.load_layer(tmp_path / "m.yaml").layer.tolist() == [layer]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": "none.pgm"}, "none.pgm: cannot be read"),
        ({"image": "no\0ne.pgm"}, "cannot be read .embedded null byte"),
        ({"mode": "colourful"}, "mode: got 'colourful', expected one of: raw, scale, trinary"),
        ({"resolution": -0.1}, "resolution: got -0.1"),
        ({"resolution": "wide"}, "cannot be read"),
        ({"free_thresh": 0.9}, "got free_thresh 0.9 and occupied_thresh 0.65"),
        ({"origin": [0.0, 0.0, 0.3]}, "origin .*0.3"),
        ({"origin": [0.0, 0.0]}, "cannot be read"),
        ({"origin": [0.0, float("nan"), 0.0]}, "origin .*nan"),
        ({"negate": None}, "cannot be read"),
        ({"negate": float("inf")}, "cannot be read"),
    ],
)
def test_broken_maps_are_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    map_io.save_maps(tmp_path, some_maps(), [(200, 0, 0), (0, 0, 200)])
    path = tmp_path / "map.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change))
    with pytest.raises(UserError, match=message.replace("(", r"\(")):
        map_io.load_layer(path)


def png_header(side: int) -> bytes:
    header = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    data = b"IDAT" + zlib.compress(b"")
    parts = [
        struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part))
        for part in (header, data)
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(
    ("image", "size"), [(b"P5 2000000 1 255\n", "2000000 x 1"), (png_header(30_000), "30000 x 30000")]
)
def test_a_small_file_that_unpacks_to_a_large_map_is_refused(tmp_path: Path, image: bytes, size: str) -> None:
    """By its header: before, OpenCV broke at the first and reserved a gigabyte for the second."""
    map_io.save_layer(tmp_path / "map.yaml", GRID, np.zeros(GRID.shape, np.int8), "trinary")
    (tmp_path / "map.pgm").write_bytes(image)
    with pytest.raises(UserError, match=f"map.pgm: got {size} pixels, expected at most 20001 a side"):
        map_io.load_layer(tmp_path / "map.yaml")


def test_broken_files_are_refused(tmp_path: Path) -> None:
    map_io.save_maps(tmp_path, some_maps(), [(200, 0, 0), (0, 0, 200)])
    with pytest.raises(UserError, match="there is no such file"):
        map_io.load_layer(tmp_path / "nothing.yaml")
    for image in (b"P5\n60 40\n255\n", b"", b"nothing"):
        (tmp_path / "map.pgm").write_bytes(image)
        with pytest.raises(UserError, match=f"map.pgm: got {len(image)} bytes"):
            map_io.load_layer(tmp_path / "map.yaml")
    (tmp_path / "map.yaml").write_text("[1, 2")
    with pytest.raises(UserError, match="cannot be read"):
        map_io.load_layer(tmp_path / "map.yaml")
    data = (tmp_path / "semantic.npz").read_bytes()
    for place in range(60, len(data) - 400, len(data) // 40):  # a bit in each array
        flipped = bytearray(data)
        flipped[place] ^= 16
        (tmp_path / "semantic.npz").write_bytes(flipped)
        with suppress(UserError):
            map_io.load_maps(tmp_path)
    (tmp_path / "semantic.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match=r"semantic.npz: cannot be read"):
        map_io.load_maps(tmp_path)
    (tmp_path / "semantic.npz").unlink()
    with pytest.raises(UserError, match=r"semantic.npz: there is no such file"):
        map_io.load_maps(tmp_path)
    for text in (json.dumps({"features": [{}]}), "[" * 100_000):
        (tmp_path / "objects.geojson").write_text(text)
        with pytest.raises(UserError, match="objects.geojson: .*GeoJSON"):
            map_io.load_objects(tmp_path / "objects.geojson")


@pytest.mark.parametrize("resolution", [0.03, 0.05, 0.12])
def test_a_map_of_another_resolution_keeps_its_walls(resolution: float) -> None:
    layer = np.zeros(GRID.shape, np.int8)
    layer[:, :4] = -1
    layer[10] = 100
    layer[:, 33] = 100
    side = round(5 / resolution)
    grid = Grid(resolution, side, side, (-2.0, 1.5))
    got = map_io.resample_layer(LoadedLayer(GRID, layer), grid)
    x, y = grid.to_points(np.argwhere(got == 100)).T
    wall_y, wall_x = 2.5 + (40 - 10 - 0.5) * 0.05, -1.25 + (33 + 0.5) * 0.05
    reach = 0.5 * (0.05 + resolution) + 1e-9
    assert ((np.abs(x - wall_x) <= reach) | (np.abs(y - wall_y) <= reach)).all()
    inside = grid.to_cells(GRID.to_points(np.argwhere(layer == 100)))
    assert (got[tuple(inside.T)] == 100).all()
    corner = grid.to_points(np.array([0, 0]))
    assert got[0, 0] == -1 and corner[0] < -1.25
    assert (got == 0).any() and (got == -1).any()

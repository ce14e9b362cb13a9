"""Every parser of foreign files, with valid examples to start from. A new parser is one line of `PARSERS`."""

import atexit
import hashlib
import io
import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from omegaconf import OmegaConf
from PIL import Image

from imagination import plugins
from imagination.cache import MAGIC, DamagedError, decode, encode
from imagination.checkpoints import KEY, Checkpoint, ConfigInCheckpoint
from imagination.config import compose
from imagination.errors import UserError
from imagination.geometry.camera import Camera
from imagination.geometry.grid import Grid
from imagination.geometry.pose import Pose
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.mapping import files
from imagination.mapping.maps import Maps
from imagination.mapping.module import Description
from imagination.recordings.bag import BagRecording
from imagination.recordings.folder import FolderRecording
from imagination.recordings.recording import Frames, Recording
from imagination.recordings.scannet import ScanNetRecording
from imagination.recordings.tum import TumRecording
from imagination.resume import END, _read
from tests.modules import Toy
from tests.robot import BEGIN, TICK, Taken, raw, record_bag, record_folder, record_tum
from tests.scene_sources import sweet_home


class Parser(NamedTuple):
    """One parser.

    Attributes:
        name: for the command line.
        parse: reads a file.
        examples: contents of valid files.
        documented: what it may raise on others.
    """

    name: str
    parse: Callable[[Path], object]
    examples: Callable[[], Sequence[bytes]]
    documented: tuple[type[Exception], ...] = (UserError,)


def sealed(path: Path) -> object:
    """Decode an entry whose checksum fits, as a stranger would see to."""
    body = path.read_bytes()
    return decode(MAGIC + hashlib.sha256(body).digest() + body)


@cache
def entries() -> list[bytes]:
    arrays = {
        "mask": np.arange(21).reshape(3, 7) % 3 == 0,
        "depth": np.linspace(0, 8, 10, dtype=np.float16),
        "rgb": np.zeros((2, 3, 3), np.uint8),
        "nothing": np.zeros((0, 4), bool),
    }
    return [encode(arrays), encode({})]


def bodies() -> list[bytes]:
    """What lies behind the checksum."""
    return [entry[len(MAGIC) + hashlib.sha256().digest_size :] for entry in entries()]


@cache
def checkpoints() -> list[bytes]:
    config = compose("train", ["+experiment=chair_unet", "scale=test", "paths.run=."])
    config.choices = ["+experiment=chair_unet", "scale=test"]
    state = {"state_dict": {"weight": torch.zeros(2)}, KEY: ConfigInCheckpoint(config).description}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.ckpt"
        torch.save(state, path)
        return [path.read_bytes()]


@cache
def configs() -> list[bytes]:
    config = compose("train", ["+experiment=chair_unet", "scale=test", "paths.run=."])
    config.sweep_dir = None  # as the command leaves it out
    return [(OmegaConf.to_yaml(config) + END).encode()]


def corpus(path: Path) -> object:
    """Open a corpus whose index is the file."""
    from imagination.data.shards import ABOUT, INDEX, Shards

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / ABOUT).write_bytes(described()[1])
        (Path(folder) / INDEX).write_bytes(path.read_bytes())
        return Shards(folder, folder, "1GB").homes


@cache
def described() -> tuple[bytes, bytes]:
    """An index and its one chunk."""
    from imagination.data.shards import ABOUT, _write_chunk

    about = {"views": {}, "group": 2, "homes": {"train_0": 3}}
    with tempfile.TemporaryDirectory() as folder:
        written = _write_chunk(Path(folder) / ABOUT, [json.dumps(about).encode()])
        index = {"chunks": [written["entry"]], "config": written["config"]}
        return json.dumps(index).encode(), (Path(folder) / ABOUT).read_bytes()


@cache
def frames() -> list[Taken]:
    image, depth = np.full((16, 24, 3), 90, np.uint8), np.full((16, 24), 2, np.float32)
    return [Taken(BEGIN + number * TICK, Pose(0.1 * number, 0, 0), image, depth) for number in range(4)]


CAMERA = Camera.from_degrees(24, 16, 80.0, 1.1)


def recording(
    record: Callable[[Path], None], name: str, opened: Callable[[Path], Recording]
) -> tuple[Callable[[Path], object], Callable[[], list[bytes]]]:
    """What reads all of a recording one of whose files is another, and what that file is."""

    @cache
    def made() -> Path:
        folder = Path(tempfile.mkdtemp()) / "recording"
        atexit.register(shutil.rmtree, folder.parent)
        record(folder)
        return folder

    def parse(path: Path) -> object:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) / "copy"
            shutil.copytree(made(), folder)
            (folder / name).write_bytes(path.read_bytes())
            return len(list(Frames(opened(folder))))

    return parse, lambda: [(made() / name).read_bytes()]


def bag(kind: str) -> tuple[Callable[[Path], object], Callable[[], list[bytes]]]:
    """The same of a bag's file."""
    topics = dict.fromkeys(("colour", "depth", "colour_info", "depth_info", "odometry"))
    suffix = {"mcap": ".mcap", "sqlite3": ".db3", "ros1": ".bag"}[kind]

    def record(folder: Path) -> None:
        folder.mkdir()
        record_bag(folder / ("drive.bag" if kind == "ros1" else "drive"), frames(), CAMERA, kind)
        found = next(folder.rglob(f"drive{suffix}"))
        found.rename(folder / f"bag{suffix}")

    return recording(
        record,
        f"bag{suffix}",
        lambda folder: BagRecording(str(folder / f"bag{suffix}"), topics, None, None, 1000.0, 0.02, 0.5),
    )


def scannet(folder: Path) -> None:
    """Record a folder as ScanNet exports it."""
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    for name in ("color", "depth"):
        np.savetxt(folder / "intrinsic" / f"intrinsic_{name}.txt", Intrinsics.of(CAMERA).matrix)
    for number, frame in enumerate(frames()):
        cv2.imwrite(str(folder / "color" / f"{number}.png"), frame.rgb)
        cv2.imwrite(str(folder / "depth" / f"{number}.png"), raw(frame.depth, 1000))
        np.savetxt(folder / "pose" / f"{number}.txt", CAMERA.to_world(frame.pose))


@cache
def maps() -> Path:
    """A saved map."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder)
    probabilities = np.zeros((1, 20, 20), np.float32)
    probabilities[:, 4:12, 5:9] = 0.75
    known = np.ones((20, 20), np.bool_)
    grid = Grid(0.05, 20, 20, (0.0, 0.0))
    found = Maps(grid, "map", ("chair",), probabilities, known[None], probabilities[0], known)
    files.save_maps(folder, found, [(200, 0, 0)])
    return folder


def beside(name: str, read: Callable[[Path], object]) -> Callable[[Path], object]:
    """Reads a folder with the saved map in which one file is another."""

    def parse(path: Path) -> object:
        with tempfile.TemporaryDirectory() as scratch:
            for file in maps().iterdir():
                shutil.copy(file, scratch)
            (Path(scratch) / name).write_bytes(path.read_bytes())
            return read(Path(scratch))

    return parse


def tum(folder: Path) -> TumRecording:
    return TumRecording(str(folder), RgbdCamera.of(CAMERA), 5000.0, 0.02, 0.5)


def plain(folder: Path) -> FolderRecording:
    return FolderRecording(str(folder))


def record_as_tum(folder: Path) -> None:
    record_tum(folder, frames(), CAMERA)


def record_as_folder(folder: Path) -> None:
    record_folder(folder, frames(), CAMERA)


FOREIGN = [
    *(Parser(f"bag-{kind}", *bag(kind)) for kind in ("mcap", "sqlite3", "ros1")),
    *(
        Parser(f"tum-{name}", *recording(record_as_tum, f"{name}.txt", tum))
        for name in ("rgb", "depth", "groundtruth")
    ),
    *(
        Parser(
            f"scannet-{name.partition('/')[0]}",
            *recording(scannet, name, lambda folder: ScanNetRecording(str(folder), 1000.0, 30.0)),
        )
        for name in ("pose/2.txt", "intrinsic/intrinsic_color.txt", "depth/2.png")
    ),
    *(
        Parser(f"folder-{name}", *recording(record_as_folder, name, plain))
        for name in ("camera.yaml", "frames.csv", "d2.npy")
    ),
    *(
        Parser(
            f"map-{name}",
            beside(name, lambda folder: files.load_layer(folder / "map.yaml")),
            lambda name=name: [(maps() / name).read_bytes()],
        )
        for name in ("map.yaml", "map.pgm")
    ),
    Parser(
        "map-semantic.npz",
        beside(files.SEMANTIC, files.load_maps),
        lambda: [(maps() / files.SEMANTIC).read_bytes()],
    ),
    Parser("map-objects.geojson", files.load_objects, lambda: [(maps() / files.OBJECTS).read_bytes()]),
    Parser(
        "onnx-description",
        lambda path: Description.from_json(path.read_text(errors="replace"), str(path)),
        lambda: [Toy("chair", "bed").description.to_json().encode()],
    ),
]
"""Recordings, maps and what a unit's file says of itself."""

PARSERS = [
    Parser("config", _read, configs),
    Parser("checkpoint", lambda path: Checkpoint.read(path).config, checkpoints),
    Parser("cache", lambda path: decode(path.read_bytes()), entries, (DamagedError,)),
    Parser("cache-sealed", sealed, bodies, (DamagedError,)),
]
PARSERS += FOREIGN
if find_spec("litdata") is not None:  # an optional extra
    PARSERS.append(Parser("shards", corpus, lambda: described()[:1]))


SPLIT = b"\n####\n"
"""Between the members of an archive that a file stands for."""


def within(names: Sequence[str], read: Callable[[Path], object]) -> Callable[[Path], object]:
    """Read an archive whose members with these names are the parts of the file."""

    def parse(path: Path) -> object:
        parts = path.read_bytes().split(SPLIT, len(names) - 1)
        with tempfile.TemporaryDirectory() as folder:
            return read(
                sweet_home.write_archive(Path(folder) / "a.zip", dict(zip(names, parts, strict=False)))
            )

    return parse


def home(path: Path) -> object:
    """Read a home of Sweet Home 3D."""
    from imagination_sweethome3d.home_file import read_home

    return read_home(path)


def catalogue(path: Path) -> object:
    """Read a catalogue of Sweet Home 3D's furniture."""
    from imagination_sweethome3d.catalogue import read_catalogue

    return read_catalogue(path)


def model(path: Path) -> object:
    """Read and fit a model."""
    from imagination_sweethome3d.archives import opened
    from imagination_sweethome3d.models import fitted, read_model

    with opened(path) as archive:
        return fitted(read_model(archive, "m.obj"), (0.45, 0.45, 0.9), np.eye(3))


@cache
def homes_and_furniture() -> dict[str, list[bytes]]:
    """Valid files of each kind."""
    with tempfile.TemporaryDirectory() as folder:
        archive = sweet_home.write_catalogue(Path(folder) / "a.sh3f").read_bytes()
        whole = sweet_home.write_home(Path(folder) / "a.sh3d").read_bytes()
    picture = io.BytesIO()
    Image.new("RGB", (4, 4), (200, 100, 0)).save(picture, "PNG")
    parts = sweet_home.obj(sweet_home.CHAIR).encode(), sweet_home.MATERIALS.encode() + b"map_Kd p.png\n"
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        rows = file.read("PluginFurnitureCatalog.properties")
    return {
        "plan": [sweet_home.home_xml(sweet_home.furnished()).encode()],
        "rows": [rows],
        "model": [SPLIT.join([*parts, picture.getvalue()])],
        "archive": [whole],
    }


plugins.activate()
PARSERS += [
    Parser("sh3d", home, lambda: homes_and_furniture()["archive"]),
    Parser("sh3d-plan", within(["Home.xml"], home), lambda: homes_and_furniture()["plan"]),
    Parser(
        "sh3f-rows",
        within(["PluginFurnitureCatalog.properties"], catalogue),
        lambda: homes_and_furniture()["rows"],
    ),
    Parser("obj", within(["m.obj", "model.mtl", "p.png"], model), lambda: homes_and_furniture()["model"]),
]


@cache
def building(name: str) -> dict[str, bytes]:
    """Files of a tiny scanned building, its main one first."""
    with tempfile.TemporaryDirectory() as folder:
        main: Path = getattr(buildings, f"write_{name}")(Path(folder))
        return {path.name: path.read_bytes() for path in (main, *main.parent.iterdir())}


def scan(name: str, layout: "Layout", ending: str) -> Parser:
    """Read a building of which the file with this ending is exchanged."""

    def broken() -> str:
        return next(file for file in building(name) if file.endswith(ending))

    def parse(path: Path) -> object:
        with tempfile.TemporaryDirectory() as folder:
            for file, content in building(name).items():
                (Path(folder) / file).write_bytes(content)
            (Path(folder) / broken()).write_bytes(path.read_bytes())
            return layout.read(Path(folder) / next(iter(building(name))))

    return Parser(f"{name}{ending}", parse, lambda: [building(name)[broken()]])


if find_spec("plyfile") is not None and find_spec("trimesh") is not None:
    from tests.scene_sources import buildings
    from tests.scene_sources.sources import activate

    activate()  # plugins of this checkout can be imported
    from imagination_scans.hm3d import HM3D
    from imagination_scans.layouts import Layout
    from imagination_scans.matterport3d import Matterport3D
    from imagination_scans.replica import Replica

    PARSERS += [
        scan("matterport", Matterport3D(), ".house"),
        scan("matterport", Matterport3D(), ".ply"),
        scan("replica", Replica(), ".json"),
        scan("replica", Replica(), ".ply"),
        scan("hm3d", HM3D(), ".semantic.txt"),
        scan("hm3d", HM3D(), ".semantic.glb"),
        scan("hm3d", HM3D(), "k.glb"),
    ]

"""Parsers of homes and furniture of Sweet Home 3D."""

import io
import tempfile
import zipfile
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from imagination.config.plugin_registry import activate
from tests.helpers import sweet_home
from tests.robustness.parsers.parser import SPLIT, Parser, in_archive

activate()


def home(path: Path) -> object:
    """Read a home."""
    from imagination_sweethome3d.home_file import read_home

    return read_home(path)


def catalogue(path: Path) -> object:
    """Read a catalogue of furniture."""
    from imagination_sweethome3d.catalogue import read_catalogue

    return read_catalogue(path)


def archive(path: Path) -> object:
    """Read a catalogue with its names in all languages."""
    from imagination_sweethome3d.catalogue import names_in_all_languages, read_catalogue

    return read_catalogue(path), names_in_all_languages(path)


def model(path: Path) -> object:
    """Read and fit a model."""
    from imagination_sweethome3d.archives import open_archive
    from imagination_sweethome3d.models import fit_model, read_model

    with open_archive(path) as archive:
        return fit_model(read_model(archive, "m.obj"), (0.45, 0.45, 0.9), np.eye(3))


@cache
def files() -> dict[str, list[bytes]]:
    """Return valid files of each kind."""
    with tempfile.TemporaryDirectory() as folder:
        packed = sweet_home.write_catalogue(Path(folder) / "a.sh3f").read_bytes()
        home_file = sweet_home.write_home(Path(folder) / "a.sh3d").read_bytes()
    pictures = [io.BytesIO() for _ in FORMATS]
    for picture, kind in zip(pictures, FORMATS, strict=True):
        Image.new("RGB", (4, 4), (200, 100, 0)).save(picture, kind)
    parts = sweet_home.obj(sweet_home.CHAIR).encode(), sweet_home.MATERIALS.encode() + b"map_Kd p.png\n"
    with zipfile.ZipFile(io.BytesIO(packed)) as file:
        rows = file.read(ROWS)
    return {
        "plan": [sweet_home.home_xml(sweet_home.furnished()).encode()],
        "rows": [rows],
        "model": [SPLIT.join([*parts, picture.getvalue()]) for picture in pictures],
        "home": [home_file],
        "catalogue": [packed],
    }


ROWS = "PluginFurnitureCatalog.properties"
FORMATS = "PNG", "JPEG", "GIF", "BMP"

PARSERS = [
    Parser("sh3d", home, lambda: files()["home"]),
    Parser("sh3d-plan", in_archive(["Home.xml"], "a.zip", home), lambda: files()["plan"]),
    Parser("sh3f", archive, lambda: files()["catalogue"]),
    Parser("sh3f-rows", in_archive([ROWS], "a.zip", catalogue), lambda: files()["rows"]),
    Parser("obj", in_archive(["m.obj", "model.mtl", "p.png"], "a.zip", model), lambda: files()["model"]),
]

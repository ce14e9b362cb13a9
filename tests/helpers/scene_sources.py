"""One tiny scene source of each kind, for the contract test: its name and its factory for an empty folder."""

import sys
from collections.abc import Callable
from pathlib import Path

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig

from imagination.config.compose import compose
from imagination.config.plugin_registry import activate
from imagination.scenes.source import SceneSource
from tests.conftest import ROOT
from tests.helpers import scanned_buildings as buildings
from tests.helpers import sweet_home

activate()  # makes the plugins of this checkout importable


def configured(folder: Path, *overrides: str) -> DictConfig:
    """Compose the configuration of the render command at scale=test with its cache in `folder`."""
    return compose("render", ["scale=test", f"paths.cache={folder}/cache", *overrides])


def source(folder: Path, *overrides: str) -> SceneSource:
    """Instantiate the scene source of the overrides."""
    try:
        instance: SceneSource = instantiate(configured(folder, *overrides).data.scenes)
    except InstantiationException as error:
        assert error.__cause__ is not None
        raise error.__cause__ from error
    return instance


def _procedural(folder: Path) -> SceneSource:
    return source(folder)


def _furniture(folder: Path) -> SceneSource:
    sweet_home.write_catalogue(folder / "assets" / "Test.sh3f")
    return source(folder, "data/furniture=sweethome3d", f"data.furniture.folder={folder}/assets")


def _homes(folder: Path) -> SceneSource:
    sweet_home.write_catalogue(folder / "assets" / "Test.sh3f")
    sweet_home.write_home(folder / "homes" / "flat.sh3d")
    return source(
        folder,
        "data/scenes=sweethome3d",
        f"data.scenes.folder={folder}/homes",
        f"data.scenes.catalogues={folder}/assets",
    )


def _scans(name: str, write: Callable[[Path], Path]) -> Callable[[Path], SceneSource]:
    def make(folder: Path) -> SceneSource:
        write(folder / "scans")
        return source(folder, f"data/scenes={name}", f"data.scenes.folder={folder}/scans")

    return make


def _habitat(folder: Path) -> SceneSource:
    return source(folder, "data/scenes=habitat", "data.scenes.scenes={train: [a], val: [b], test: [c]}")


def _box_rooms(folder: Path) -> SceneSource:
    """Create the source of the example plugin in the documentation."""
    sys.path.append(str(ROOT / "tests" / "helpers" / "example_plugin"))
    from imagination_example.rooms import BoxRooms

    return BoxRooms({"train": 1, "val": 1, "test": 1}, 0.2)


SOURCES: dict[str, Callable[[Path], SceneSource]] = {
    "procedural": _procedural,
    "sweethome3d_furniture": _furniture,
    "sweethome3d_homes": _homes,
    "matterport3d": _scans("matterport3d", buildings.write_matterport),
    "hm3d": _scans("hm3d", buildings.write_hm3d),
    "replica": _scans("replica", buildings.write_replica),
    "scannet": _scans("scannet", buildings.write_scannet),
    "habitat": _habitat,
    "box_rooms": _box_rooms,
}
NEEDS = {"scannet": "scenezoo"}
"""Optional libraries of sources; sources without them are skipped."""

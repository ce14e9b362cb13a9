"""Parsers of scanned buildings."""

import shutil
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from imagination.config.plugin_registry import activate
from tests.robustness.parsers.parser import Parser, temporary_folder, with_file_replaced

PARSERS: list[Parser] = []

if find_spec("plyfile") is not None and find_spec("trimesh") is not None:  # an optional extra
    activate()
    from imagination_scans.hm3d import HM3D
    from imagination_scans.layouts import Layout, split_lists
    from imagination_scans.matterport3d import Matterport3D
    from imagination_scans.replica import Replica

    from tests.helpers import scanned_buildings as buildings

    def scan(name: str, layout: Layout, stem: str, main: str, suffixes: list[str]) -> list[Parser]:
        """Return parsers of a building, one for each file that is replaced."""
        folder = temporary_folder(getattr(buildings, f"write_{name}"))
        return [
            Parser(
                f"{name}{suffix}",
                *with_file_replaced(folder, stem + suffix, lambda copy: layout.read(copy / (stem + main))),
            )
            for suffix in suffixes
        ]

    def lists(path: Path) -> object:
        """Read the list of a split."""
        with TemporaryDirectory() as folder:
            shutil.copyfile(path, Path(folder) / "scenes_train.txt")
            return split_lists(Path(folder), "scenes_{split}.txt")

    PARSERS.append(Parser("scan-lists", lists, lambda: [b"17DRP5sb8fy\n1LXtFkjw3qL\n"]))
    HOUSE = "17DRP5sb8fy/house_segmentations/17DRP5sb8fy"
    PARSERS += scan("matterport", Matterport3D(), HOUSE, ".house", [".house", ".ply"])
    ROOM = "room_0/habitat/"
    PARSERS += scan(
        "replica", Replica(), ROOM, "info_semantic.json", ["info_semantic.json", "mesh_semantic.ply"]
    )
    BUILDING = "train/00001-abcdefghijk/abcdefghijk"
    PARSERS += scan("hm3d", HM3D(), BUILDING, ".semantic.txt", [".semantic.txt", ".semantic.glb", ".glb"])

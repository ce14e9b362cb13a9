"""Parsers of a dataset of shards: its index, chunks, and records of scenes."""

import tempfile
from pathlib import Path

from imagination.data.shards.reader import Shards
from imagination.data.shards.writer import ABOUT, INDEX, ShardSpec, unwritten, write_index, write_scene
from imagination.views.pose_samplers import UniformPoses
from tests.data.test_datamodule import observer
from tests.helpers.room_source import Rooms
from tests.robustness.parsers.parser import Parser, temporary_folder, with_file_replaced

SCENE = "train_0"

SPEC = ShardSpec(UniformPoses(), seed=1, views=4, group=2)


def write(folder: Path) -> None:
    """Write a dataset of one scene."""
    folder.mkdir()
    with tempfile.TemporaryDirectory() as cache:
        write_scene(views := observer(Path(cache), Rooms(1)), SCENE, folder, SPEC)
        write_index(folder, views, SPEC)


def read(folder: Path) -> object:
    """Read all views, without the 2 s that litdata waits for the rest of a truncated chunk."""
    from litdata.streaming import item_loader

    item_loader._MAX_WAIT_TIME = 0.05
    shards = Shards(str(folder), str(folder / "unused"), 1.0)
    return [shards.read(scene, number) for scene, items in shards.scenes.items() for number in range(items)]


def resume(folder: Path) -> object:
    """List the missing scenes and write the index, as a resumed job does."""
    views = observer(folder / "cache", Rooms(1))
    return unwritten(folder, views, [SCENE], SPEC), write_index(folder, views, SPEC)


SHARDS = temporary_folder(write)
PARSERS = [
    Parser("shards-index", *with_file_replaced(SHARDS, INDEX, read)),
    Parser("shards-about", *with_file_replaced(SHARDS, ABOUT, read)),
    Parser("shards-chunk", *with_file_replaced(SHARDS, f"chunk-{SCENE}.bin", read)),
    Parser("shards-record", *with_file_replaced(SHARDS, f"{SCENE}.record.json", resume)),
]

"""Parsers of a corpus of views as shards: its index, chunks, and the records of scenes."""

import tempfile
from pathlib import Path

from imagination.data.shards.reader import Shards
from imagination.data.shards.writer import ABOUT, INDEX, ShardSpec, unwritten, write_index, write_scene
from imagination.views.pose_samplers import UniformPoses
from tests.data.test_datamodule import observer
from tests.helpers.room_source import Rooms
from tests.robustness.parsers.parser import Parser, exchanged, kept

HOME = "train_0"

RECIPE = ShardSpec(UniformPoses(), seed=1, views=4, group=2)


def write(folder: Path) -> None:
    """Write a corpus of one scene."""
    folder.mkdir()
    with tempfile.TemporaryDirectory() as cache:
        write_scene(watcher := observer(Path(cache), Rooms(1)), HOME, folder, RECIPE)
        write_index(folder, watcher, RECIPE)


def read(folder: Path) -> object:
    """Every view; nothing is waited for 2 s, as litdata does for the rest of a chunk that is cut off."""
    from litdata.streaming import item_loader

    item_loader._MAX_WAIT_TIME = 0.05
    corpus = Shards(str(folder), str(folder / "unused"), 1.0)
    return [corpus.read(scene, number) for scene, items in corpus.scenes.items() for number in range(items)]


def go_on(folder: Path) -> object:
    """See which scenes are there, as the next of several jobs does."""
    watcher = observer(folder / "cache", Rooms(1))
    return unwritten(folder, watcher, [HOME], RECIPE), write_index(folder, watcher, RECIPE)


CORPUS = kept(write)
PARSERS = [
    Parser("shards-index", *exchanged(CORPUS, INDEX, read)),
    Parser("shards-about", *exchanged(CORPUS, ABOUT, read)),
    Parser("shards-chunk", *exchanged(CORPUS, f"chunk-{HOME}.bin", read)),
    Parser("shards-record", *exchanged(CORPUS, f"{HOME}.record.json", go_on)),
]

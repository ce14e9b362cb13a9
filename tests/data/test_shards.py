"""Corpora as shards: written home by home, gone on with, streamed into the same training."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra.utils import instantiate

from imagination import errors
from imagination.config import compose
from imagination.data import shards
from imagination.data.shards import INDEX, Recipe, ShardCollector, Shards
from imagination.errors import UserError
from imagination.views.collector import Views, look
from imagination.views.samplers import UniformPoses
from tests.conftest import Command
from tests.data.test_collecting import observer, same
from tests.sources import Rooms

pytest.importorskip("litdata")

RECIPE = Recipe(UniformPoses(), seed=1, views=12, group=2)
HOMES = Rooms(5).scenes("train")


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    watcher = observer(tmp_path_factory.mktemp("cache"), Rooms(5))
    for home in HOMES:
        shards.write_home(watcher, home, folder, RECIPE)
    shards.write_index(folder, watcher, RECIPE)
    return folder


def opened(folder: Path) -> Shards:
    return Shards(str(folder), str(folder / "unused"), "1GB")


def poses(views: Views) -> list[tuple[float, ...]]:
    return [tuple(pose) for pose in views["pose"].tolist()]


def test_what_is_written_is_read(corpus: Path, tmp_path: Path) -> None:
    watcher, read = observer(tmp_path, Rooms(5)), opened(corpus)
    assert read.homes == dict.fromkeys(sorted(HOMES), 6) and read.group == 2
    read.check(watcher)
    from zlib import crc32

    seed = (1, shards.Stream.SHARDS, crc32(b"train_3"), 4)
    assert same(read.read("train_3", 4), look(watcher, "train_3", UniformPoses(), seed, 2))


def test_every_view_comes_once_a_lap_whatever_is_asked_first(corpus: Path) -> None:
    collector = ShardCollector(opened(corpus), HOMES, seed=3, parallel_scenes=5, steps=4)
    assert collector.views_per_collection == 20
    lap = [collector.start(index)() for index in range(3)]  # 5 homes x 12 views = 3 collections of 20
    seen = [pose for views in lap for pose in poses(views)]
    assert len(set(seen)) == 60
    again = ShardCollector(opened(corpus), HOMES, seed=3, parallel_scenes=5, steps=4)
    assert all(same(again.start(index)(), lap[index]) for index in (2, 0, 1))
    next_lap = [pose for index in range(3, 6) for pose in poses(collector.start(index)())]
    assert set(next_lap) == set(seen) and next_lap != seen
    other = ShardCollector(opened(corpus), HOMES, seed=4, parallel_scenes=5, steps=4)
    assert not same(other.start(0)(), lap[0])


def test_views_of_another_camera_are_refused(corpus: Path, tmp_path: Path) -> None:
    watcher = observer(tmp_path, Rooms(5))
    other = replace(watcher, camera=replace(watcher.camera, mount_height=1.0))
    with pytest.raises(UserError, match="were made with camera .*1.25.* but the config asks for .*1.0"):
        opened(corpus).check(other)
    with pytest.raises(UserError, match="write them with that interval"):
        ShardCollector(opened(corpus), HOMES, 0, 2, steps=5)


def test_damage_and_absence_are_told(corpus: Path, tmp_path: Path) -> None:
    for path in corpus.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    chunk = tmp_path / "chunk-train_1.bin"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(bytes(content))
    read = opened(tmp_path)
    with pytest.raises(UserError, match=r"is damaged; remove chunk-train_1.bin"):
        [read.read("train_1", number) for number in range(6)]
    read.read("train_2", 0)
    with pytest.raises(UserError, match=f"there is no {INDEX}"):
        opened(tmp_path / "nowhere")
    (tmp_path / INDEX).write_text("{}")
    with pytest.raises(UserError, match="cannot be read"):
        opened(tmp_path)
    (tmp_path / INDEX).unlink()
    with pytest.raises(UserError, match="there is no index.json"):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("part", "value", "told"),
    [
        ("data_format", ["pickle"], "expected plain bytes"),
        ("item_loader", "TokensLoader", "expected PyTreeLoader"),
    ],
)
def test_an_index_that_would_run_code_is_refused(
    corpus: Path, tmp_path: Path, part: str, value: object, told: str
) -> None:
    for path in corpus.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    index = json.loads((tmp_path / INDEX).read_text())
    (tmp_path / INDEX).write_text(json.dumps({**index, "config": {**index["config"], part: value}}))
    with pytest.raises(UserError, match=told):
        opened(tmp_path)
    index["chunks"][1]["filename"] = "../chunk-a.bin"
    (tmp_path / INDEX).write_text(json.dumps(index))
    with pytest.raises(UserError, match="names a chunk"):
        opened(tmp_path)


def test_a_missing_extra_names_the_command(monkeypatch: pytest.MonkeyPatch, corpus: Path) -> None:
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"litdata: is not installed.*pip install 'imagination\[shards\]'"):
        opened(corpus)


class Attic(Rooms):
    """Rooms of which one is broken."""

    def load(self, scene: str) -> Any:
        if scene == "train_1":
            raise OSError("its roof is missing")
        return super().load(scene)


WRITE = ["scale=test", "scale.homes.train=3", "views=8", "+shards=corpus"]


def test_the_command_writes_goes_on_and_training_streams(command: Command, tmp_path: Path) -> None:
    done = command("render", *WRITE, "part=0", "parts=2")
    assert done.returncode == 0 and "2 homes, 16 views" in done.stderr, done.stderr
    first = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "corpus").glob("chunk-train*")}
    done = command("render", *WRITE)  # all of them: those that are there stay
    assert done.returncode == 0 and "3 homes, 24 views" in done.stderr, done.stderr
    assert "a million take" in done.stderr
    assert all((tmp_path / "corpus" / name).stat().st_mtime_ns == time for name, time in first.items())
    done = command("train", "+experiment=chair_unet", "scale=test", "data=shards", "data.shards=corpus")
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "outputs" / "chair_unet").glob("*/tables/mapping.csv"))
    done = command(
        "train", "+experiment=chair_unet", "scale=test", "scale.image=40", "data=shards", "data.shards=corpus"
    )
    assert done.returncode == 2 and "were made with camera" in done.stderr and "Traceback" not in done.stderr


def test_a_broken_home_is_told_and_left_out(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "plugins" / "attic"
    (folder / "conf" / "data" / "scenes").mkdir(parents=True)
    (folder / "attic").mkdir()
    (folder / "attic" / "__init__.py").write_text("")
    (folder / "attic" / "rooms.py").write_text(
        "from tests.data.test_shards import Attic\nclass Rooms(Attic):\n    pass\n"
    )
    (folder / "conf" / "data" / "scenes" / "attic.yaml").write_text("_target_: attic.rooms.Rooms\ncount: 3\n")
    done = command("render", "scale=test", "views=4", "+shards=corpus", "data/scenes=attic")
    assert done.returncode == 0, done.stderr
    assert "train_1 is left out: OSError: its roof is missing" in done.stderr
    assert "1 homes failed: train_1; run this again" in done.stderr
    homes = Shards(str(tmp_path / "corpus"), "", "1GB").homes
    assert list(homes) == ["train_0", "train_2"]


def test_the_config_builds(corpus: Path) -> None:
    config = compose(
        "train",
        ["+experiment=chair_unet", "scale=test", "data=shards", f"data.shards={corpus}", "paths.run=."],
    )
    module = instantiate(config.data.module)
    with pytest.raises(UserError, match="were made with"):
        module.collector(4)
    assert json.loads((corpus / INDEX).read_text())["chunks"][0]["filename"] == shards.ABOUT
    assert np.isfinite(module.batch_size)

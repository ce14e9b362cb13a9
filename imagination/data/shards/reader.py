"""Training views streamed out of a corpus (imagination.data.shards.writer), in a folder or behind a URL."""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from imagination.data.datamodule import SceneData
from imagination.data.shards.writer import INDEX, as_read, chunk_name, describe, difference, prepare_litdata
from imagination.utils.cache import as_plain, decode
from imagination.utils.errors import UserError, check_range, first_of
from imagination.utils.process_group import global_rank, world_size
from imagination.views.collector import Views, concatenate
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream

log = logging.getLogger(__name__)


def check_index(index: Any, folder: Path | None) -> None:
    """Check that an index is one of ours: bytes only, since litdata would unpickle others, in chunks beside it.

    Args:
        index: as read.
        folder: in which the chunks are; None if they are not fetched yet.

    Raises:
        UserError: if it is not.
    """
    config, chunks = index["config"], index["chunks"]
    if config["data_format"] != ["bytes"] or config["compression"] or config.get("encryption"):
        raise UserError(
            f"data.shards: got items of {config['data_format']}, expected plain bytes; do not use this corpus"
        )
    if config["item_loader"] != "PyTreeLoader":
        raise UserError(f"data.shards: got item_loader {config['item_loader']!r}, expected PyTreeLoader")
    for chunk in chunks:
        name = chunk["filename"]
        if not re.fullmatch(r"chunk-[\w.+-]+\.bin", name) or (folder and not (folder / name).is_file()):
            raise UserError(
                f"data.shards: the index names a chunk {name!r}, which is not there; write it again"
            )


def _fetched(place: str, **options: Any) -> Any:
    """What lies behind a URL, its index fetched."""
    from litdata import StreamingDataset

    try:
        items = StreamingDataset(place, **options)
        len(items)  # fetches the index
        return items
    except Exception as error:  # each storage's client has its own
        reason = str(error).partition("\n")[0]
        raise UserError(
            f"data.shards: {place} cannot be fetched ({reason}); check the address and the credentials of its storage"
        ) from error


class Shards:
    """A corpus to read from.

    Args:
        place: folder or URL (s3://…, gs://…).
        cache: folder for chunks of a URL.
        gigabytes: most that is kept there.

    Raises:
        UserError: if there is no corpus, or the size is out of range.
    """

    def __init__(self, place: str, cache: str, gigabytes: float) -> None:
        prepare_litdata()
        from litdata import StreamingDataset

        self.place = place
        self.gigabytes = check_range("data.module.shard_gigabytes", gigabytes, 0.0, 1e6, "GB", open_low=True)
        remote = "://" in place
        if not remote and not (Path(place) / INDEX).is_file():
            raise UserError(
                f"data.shards: got {place}, where there is no {INDEX}; expected a folder that "
                "python -m imagination.prepare_shards shards=… wrote, or a URL of one"
            )
        own = Path(cache) / hashlib.sha256(place.encode()).hexdigest()[:16]
        try:
            if remote:
                self._items = _fetched(place, cache_dir=str(own), max_cache_size=f"{gigabytes}GB")
            chunks = []
            for index in own.rglob(INDEX) if remote else [Path(place) / INDEX]:
                listed = json.loads(index.read_text())
                check_index(listed, None if remote else Path(place))
                chunks += [int(chunk["chunk_bytes"]) for chunk in listed["chunks"]]
            self.largest_chunk = max(chunks)
            if not remote:
                self._items = StreamingDataset(place)
            about = json.loads(bytes(self._items[0]))
            self.recipe: dict[str, Any] = about["recipe"]
            self.group: int = int(self.recipe["group"])
            self.sampler: dict[str, Any] = dict(self.recipe["sampler"])
            scenes = about["scenes"].items()
            self.scenes: dict[str, int] = {str(scene): int(each["items"]) for scene, each in scenes}
            self.fingerprints: dict[str, str] = {
                str(scene): str(each["fingerprint"]) for scene, each in scenes
            }
            self.views: dict[str, Any] = about["views"]
        except UserError:
            raise
        except Exception as error:  # litdata raises whatever a damaged file makes it raise
            raise UserError(f"data.shards: {place} cannot be read ({error}); write it again") from error
        self._first = dict(zip(self.scenes, np.cumsum([1, *self.scenes.values()]).tolist(), strict=False))

    def read(self, scene: str, number: int) -> Views:
        """One group of views of a scene.

        Raises:
            UserError: if it is damaged or cannot be fetched.
        """
        try:
            return decode(bytes(self._items[self._first[scene] + number]))
        except Exception as error:  # litdata raises anything on a chunk that is cut off
            raise UserError(
                f"data.shards: item {number} of {scene} in {self.place} cannot be read ({error}); if it is damaged, "
                f"remove {chunk_name(scene)} and write it again"
            ) from error

    def check_room(self, scenes: int) -> None:
        """Check that so many scenes can be kept at once: else chunks would be fetched anew for every collection.

        Raises:
            UserError: if they cannot.
        """
        needed = scenes * self.largest_chunk / 1e9
        if "://" in self.place and needed > self.gigabytes:
            raise UserError(
                f"data.module.shard_gigabytes: got {self.gigabytes}, expected at least {needed:.3g} GB, the chunks of "
                f"the {scenes} scenes that are looked into at once; or take fewer, scale.parallel_scenes"
            )

    def check(self, observer: Observer) -> None:
        """Check that views are what the config asks for.

        Raises:
            UserError: with the first part that differs.
        """
        if different := difference(self.views, as_read(describe(observer))):
            raise UserError(
                f"data.shards: the views in {self.place} were made with {different}; choose the scale and "
                "settings they were written with"
            )

    def check_scenes(self, observer: Observer, scenes: Sequence[str]) -> None:
        """Check that scenes are those that the config's scene source has under these names.

        Raises:
            UserError: with those that differ.
        """
        if others := [
            scene for scene in scenes if self.fingerprints[scene] != observer.source.fingerprint(scene)
        ]:
            raise UserError(
                f"data.shards: {self.place} was written of other scenes than the config's of these names: "
                f"{first_of(others)}; choose the scene source and furniture it was written of"
            )


class ShardCollector:
    """Collections of training views out of shards, in place of rendering them; see `Collector`.

    So many scenes as are looked at in parallel are open at once, and read through before the next: a chunk is fetched
    once a lap. Which views a collection gets depends on the seed and its number alone.

    Args:
        shards: to read from.
        scenes: this process's own.
        seed: of the run.
        parallel_scenes: scenes in one collection.
        steps: views of each of them.

    Raises:
        UserError: if the views do not divide into collections.
    """

    def __init__(
        self, shards: Shards, scenes: Sequence[str], seed: int, parallel_scenes: int, steps: int
    ) -> None:
        self.shards, self.scenes, self.seed = shards, list(scenes), seed
        self.parallel_scenes, self.steps = parallel_scenes, steps
        items = min((shards.scenes[scene] for scene in scenes), default=0)
        if not items or steps % shards.group or steps // shards.group > items:
            raise UserError(
                f"data.shards: got {len(self.scenes)} scenes of {items} x {shards.group} views, expected at least one "
                f"scene and collections of scale.update_interval = {steps} views of each; write them with that interval"
            )
        self._items_each = steps // shards.group
        self._collections = items // self._items_each  # out of the same scenes
        self._reader = ThreadPoolExecutor(1)

    @property
    def views_per_collection(self) -> int:
        return self.parallel_scenes * self.steps

    def start(self, index: int) -> Callable[[], Views]:
        """Begin to read collection `index`; the function returned waits for it."""
        return self._reader.submit(self._read, index).result

    def _read(self, index: int) -> Views:
        window, turn = divmod(index, self._collections)
        parts = []
        for slot in range(self.parallel_scenes):
            lap, place = divmod(window * self.parallel_scenes + slot, len(self.scenes))
            scene = self.scenes[self._shuffled(len(self.scenes), lap)[place]]
            order = self._shuffled(self.shards.scenes[scene], lap, crc32(scene.encode()))
            chosen = order[turn * self._items_each : (turn + 1) * self._items_each]
            parts += [self.shards.read(scene, number) for number in chosen]
        return concatenate(parts)

    def _shuffled(self, count: int, *seed: int) -> list[int]:
        rng = np.random.default_rng([self.seed, Stream.SHARDS, *seed])
        order: list[int] = rng.permutation(count).tolist()
        return order


class ShardData(SceneData):
    """Training views streamed from shards; those of validation and test as in `SceneData`.

    Args:
        shards: folder or URL that `python -m imagination.prepare_shards shards=…` wrote.
        shard_cache: folder for chunks of a URL.
        shard_gigabytes: most that is kept there.
        others: see `SceneData`.
    """

    def __init__(self, shards: str, shard_cache: str, shard_gigabytes: float, **others: Any) -> None:
        super().__init__(**others)
        self._where = shards, shard_cache, shard_gigabytes
        self._collector: ShardCollector | None = None
        self._homes: list[str] = []
        self._recipe: dict[str, Any] = {}

    def setup(self, stage: str) -> None:
        if stage == "fit":
            self.survey("val")  # training needs no truth: it is in the views
        else:
            super().setup(stage)

    def collector(self, steps: int) -> ShardCollector:  # type: ignore[override]  # start and views_per_collection alike
        if self._collector is None:
            shards = Shards(*self._where)
            shards.check(self.observer)
            self._homes = self._training_homes(shards)
            self._recipe = shards.recipe
            shards.check_scenes(self.observer, self._homes)
            own = as_read(as_plain(self.sampler))
            if different := difference(shards.sampler, own):
                log.warning("data.shards: poses in %s were drawn with %s", shards.place, different)
            share = self.parallel_scenes // world_size()
            shards.check_room(min(self.parallel_scenes, len(self._homes)))
            self._collector = ShardCollector(
                shards, self._homes[global_rank() :: world_size()], self.seed, share, steps
            )
        return self._collector

    def state_dict(self) -> dict[str, Any]:
        """The scenes that this run trains on, and how they were looked at: a corpus may grow or move."""
        scenes = {scene: self.observer.source.fingerprint(scene) for scene in self._homes}
        return {"scenes": scenes, "recipe": self._recipe}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._homes, self._recipe = list(state_dict["scenes"]), state_dict["recipe"]

    def _training_homes(self, shards: Shards) -> list[str]:
        """Those of the training split that the corpus holds; of a run that goes on, those that it began with.

        Raises:
            UserError: if there are none, some of those are gone, or the corpus is another than the run began with.
        """
        if self._homes:
            if self._recipe != shards.recipe:
                raise UserError(
                    f"data.shards: the views in {shards.place} were drawn with {shards.recipe}, expected "
                    f"{self._recipe}, which this run began with; go on with that corpus, or start a new run"
                )
            if lost := [scene for scene in self._homes if scene not in shards.scenes]:
                raise UserError(
                    f"data.shards: {shards.place} does not hold {first_of(lost)} any more, which this run began "
                    "with; write them again, or start a new run"
                )
            return self._homes
        asked = self.observer.source.scenes("train")
        scenes = [scene for scene in asked if scene in shards.scenes]
        if not scenes:
            raise UserError(
                f"data.shards: {shards.place} holds {first_of(list(shards.scenes))}, expected scenes of the "
                f"training split: {first_of(asked)}; choose the scene source it was written with"
            )
        if missing := len(asked) - len(scenes):
            log.warning("data.shards: %d of the %d scenes of training are not in it", missing, len(asked))
        if others := len(shards.scenes) - len(scenes):
            log.warning("data.shards: %d scenes in it are not of this training and left out", others)
        return scenes

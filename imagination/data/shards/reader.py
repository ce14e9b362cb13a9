"""Streaming of training views from a dataset of shards (see imagination.data.shards.writer) in a folder or at a URL."""

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

from imagination.data.datamodule import TRAINING_SCENES, SceneData
from imagination.data.shards.writer import (
    INDEX,
    chunk_name,
    describe,
    first_difference,
    json_round_trip,
    prepare_litdata,
)
from imagination.utils.cache import decode
from imagination.utils.cache_key import as_plain
from imagination.utils.errors import UserError, check_range, first_of
from imagination.utils.process_group import global_rank, world_size
from imagination.views.collector import Views, concatenate
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream

log = logging.getLogger(__name__)


def check_index(index: Any, folder: Path | None) -> None:
    """Check that all items of an index are plain bytes and that its chunks exist.

    litdata unpickles items of other types, which can execute code.

    Args:
        index: content of the index file.
        folder: folder of the chunks; None if they are not fetched yet.

    Raises:
        UserError: if an item has another type, or a chunk does not exist.
    """
    config, chunks = index["config"], index["chunks"]
    if config["data_format"] != ["bytes"] or config["compression"] or config.get("encryption"):
        raise UserError(
            f"data.shards: got items of {config['data_format']}, compression {config['compression']} and encryption "
            f"{config.get('encryption')}, expected plain bytes; other items can execute code: do not use this dataset"
        )
    if config["item_loader"] != "PyTreeLoader":
        raise UserError(
            f"data.shards: got item_loader {config['item_loader']!r}, expected PyTreeLoader; do not use this dataset"
        )
    for chunk in chunks:
        name = chunk["filename"]
        if not re.fullmatch(r"chunk-[\w.+-]+\.bin", name) or (folder and not (folder / name).is_file()):
            raise UserError(
                f"data.shards: got the chunk {name!r} in the index, expected an existing chunk-*.bin; "
                "write the dataset again"
            )


def _open_remote(url: str, **options: Any) -> Any:
    """Open the dataset at a URL and fetch its index."""
    from litdata import StreamingDataset

    try:
        dataset = StreamingDataset(url, **options)
        len(dataset)  # fetches the index
        return dataset
    except Exception as error:  # storage clients have no common exception class
        reason = str(error).partition("\n")[0]
        raise UserError(
            f"data.shards: {url} cannot be fetched ({reason}); check the URL and the credentials of the storage"
        ) from error


class Shards:
    """Dataset of shards, opened for reading.

    Args:
        place: folder or URL (s3://…, gs://…) of the dataset.
        cache: folder for cached chunks of a URL.
        gigabytes: maximum size of the cache, GB.

    Attributes:
        spec: specification of the views; see `ShardSpec`.
        group: number of views in a group (an item of the dataset).
        sampler: description of the pose sampler.
        scenes: number of groups of each scene.
        fingerprints: fingerprint of each scene.
        views: settings that the views were rendered with.
        largest_chunk: size of the largest chunk, bytes.

    Raises:
        UserError: if there is no dataset, it cannot be read, or the cache size is out of range.
    """

    def __init__(self, place: str, cache: str, gigabytes: float) -> None:
        prepare_litdata()
        from litdata import StreamingDataset

        self.place = place
        self.gigabytes = check_range("data.module.shard_gigabytes", gigabytes, 0.0, 1e6, "GB", open_low=True)
        remote = "://" in place
        if not remote and not (Path(place) / INDEX).is_file():
            raise UserError(
                f"data.shards: got {place}, which holds no {INDEX}; expected a folder written by "
                "python -m imagination.prepare_shards shards=…, or a URL of one"
            )
        cache_folder = Path(cache) / hashlib.sha256(place.encode()).hexdigest()[:16]
        try:
            if remote:
                self._items = _open_remote(
                    place, cache_dir=str(cache_folder), max_cache_size=f"{gigabytes}GB"
                )
            sizes = []
            for path in cache_folder.rglob(INDEX) if remote else [Path(place) / INDEX]:
                index = json.loads(path.read_text())
                check_index(index, None if remote else Path(place))
                sizes += [int(chunk["chunk_bytes"]) for chunk in index["chunks"]]
            self.largest_chunk = max(sizes)
            if not remote:
                self._items = StreamingDataset(place)
            about = json.loads(bytes(self._items[0]))
            self.spec: dict[str, Any] = about["recipe"]
            self.group: int = int(self.spec["group"])
            self.sampler: dict[str, Any] = dict(self.spec["sampler"])
            scenes = about["scenes"].items()
            self.scenes: dict[str, int] = {str(scene): int(entry["items"]) for scene, entry in scenes}
            self.fingerprints: dict[str, str] = {
                str(scene): str(entry["fingerprint"]) for scene, entry in scenes
            }
            self.views: dict[str, Any] = about["views"]
        except UserError:
            raise
        except Exception as error:  # litdata raises various exceptions on damaged files
            raise UserError(f"data.shards: {place} cannot be read ({error}); write it again") from error
        # item 0 describes the dataset; the groups of each scene start here
        self._first = dict(zip(self.scenes, np.cumsum([1, *self.scenes.values()]).tolist(), strict=False))

    def read(self, scene: str, number: int) -> Views:
        """Read group `number` of the views of a scene.

        Raises:
            UserError: if the group is damaged or cannot be fetched.
        """
        try:
            return decode(bytes(self._items[self._first[scene] + number]))
        except Exception as error:  # litdata raises various exceptions on truncated chunks
            raise UserError(
                f"data.shards: item {number} of {scene} in {self.place} cannot be read ({error}); if it is damaged, "
                f"remove {chunk_name(scene)} and write it again"
            ) from error

    def check_cache_size(self, scenes: int) -> None:
        """Check that the cache can hold the chunks of `scenes` scenes; otherwise every collection would refetch them.

        Raises:
            UserError: if the cache is too small.
        """
        needed = scenes * self.largest_chunk / 1e9
        if "://" in self.place and needed > self.gigabytes:
            raise UserError(
                f"data.module.shard_gigabytes: got {self.gigabytes}, expected at least {needed:.3g} GB for the chunks "
                f"of {scenes} parallel scenes; raise it or lower data.parallel_scenes"
            )

    def check(self, observer: Observer) -> None:
        """Check that the views were rendered with the settings of the config.

        Raises:
            UserError: if a setting differs.
        """
        if mismatch := first_difference(self.views, json_round_trip(describe(observer))):
            raise UserError(
                f"data.shards: got views in {self.place} that were rendered with {mismatch}; use the scale and "
                "settings with which they were written"
            )

    def check_scenes(self, observer: Observer, scenes: Sequence[str]) -> None:
        """Check that scenes of the dataset equal those of the same names in the config's scene source.

        Raises:
            UserError: if a scene differs.
        """
        if changed := [scene for scene in scenes if self.fingerprints[scene] != observer.fingerprint(scene)]:
            raise UserError(
                f"data.shards: got scenes in {self.place} that differ from those of the same names in the config's "
                f"scene source: {first_of(changed)}; use the scene source and furniture with which they were written"
            )


class ShardCollector:
    """Collector that reads training views from shards instead of rendering them; see `Collector`.

    All views of a block of parallel scenes are read before the next block starts, so that each chunk is fetched once
    per pass through the dataset. The views of a collection depend only on the seed and the index of the collection.

    Args:
        shards: dataset to read from.
        scenes: scenes of this process.
        seed: seed of the run.
        parallel_scenes: number of scenes in one collection.
        steps: number of views per scene in one collection.

    Raises:
        UserError: if there is no scene, or the views cannot be divided into collections.
    """

    def __init__(
        self, shards: Shards, scenes: Sequence[str], seed: int, parallel_scenes: int, steps: int
    ) -> None:
        self.shards, self.scenes, self.seed = shards, list(scenes), seed
        self.parallel_scenes, self.steps = parallel_scenes, steps
        items = min((shards.scenes[scene] for scene in scenes), default=0)
        if not items or steps % shards.group or steps // shards.group > items:
            raise UserError(
                f"data.shards: got {len(self.scenes)} scenes with {items} groups of {shards.group} views, expected at "
                f"least one scene with {steps} views, in groups whose size divides "
                f"callbacks.replay_buffer.update_interval = {steps}; write the shards with this "
                "update interval"
            )
        self._groups_per_scene = steps // shards.group  # in one collection
        self._collections_per_block = items // self._groups_per_scene
        self._reader = ThreadPoolExecutor(1)

    @property
    def views_per_collection(self) -> int:
        return self.parallel_scenes * self.steps

    def start(self, index: int) -> Callable[[], Views]:
        """Start reading collection `index` and return a function that waits for it."""
        return self._reader.submit(self._read, index).result

    def _read(self, index: int) -> Views:
        """Read the views of collection `index`."""
        block, collection = divmod(index, self._collections_per_block)
        parts = []
        for slot in range(self.parallel_scenes):
            cycle, position = divmod(block * self.parallel_scenes + slot, len(self.scenes))
            scene = self.scenes[self._shuffled(len(self.scenes), cycle)[position]]
            order = self._shuffled(self.shards.scenes[scene], cycle, crc32(scene.encode()))
            numbers = order[collection * self._groups_per_scene : (collection + 1) * self._groups_per_scene]
            parts += [self.shards.read(scene, number) for number in numbers]
        return concatenate(parts)

    def _shuffled(self, count: int, *seed: int) -> list[int]:
        """Return a random permutation of range(count), which depends only on the run's seed and `seed`."""
        rng = np.random.default_rng([self.seed, Stream.SHARDS, *seed])
        order: list[int] = rng.permutation(count).tolist()
        return order


class ShardData(SceneData):
    """Training views streamed from shards; validation and test views are rendered as in `SceneData`.

    Args:
        shards: folder or URL of a dataset written by `python -m imagination.prepare_shards shards=…`.
        shard_cache: folder for cached chunks of a URL.
        shard_gigabytes: maximum size of the cache, GB.
        others: further arguments of `SceneData`.
    """

    fit_splits = ("val",)  # the shards hold the ground truth of training views

    def __init__(self, shards: str, shard_cache: str, shard_gigabytes: float, **others: Any) -> None:
        super().__init__(**others)
        self._dataset = shards, shard_cache, shard_gigabytes
        self._collector: ShardCollector | None = None
        self._scenes: list[str] = []
        self._spec: dict[str, Any] = {}

    def collector(self, steps: int) -> ShardCollector:
        if self._collector is None:
            shards = Shards(*self._dataset)
            shards.check(self.observer)
            self._scenes = self._training_scenes(shards)
            self._spec = shards.spec
            shards.check_scenes(self.observer, self._scenes)
            sampler = json_round_trip(as_plain(self.sampler))
            if mismatch := first_difference(shards.sampler, sampler):
                log.warning("data.shards: poses in %s were drawn with %s", shards.place, mismatch)
            parallel = self.parallel_scenes // world_size()
            shards.check_cache_size(min(self.parallel_scenes, len(self._scenes)))
            self._collector = ShardCollector(
                shards, self._scenes[global_rank() :: world_size()], self.seed, parallel, steps
            )
        return self._collector

    def state_dict(self) -> dict[str, Any]:
        """Return the training scenes and the specification of their views, since a dataset may grow or move."""
        fingerprints = self._fingerprints(self._scenes)
        return {TRAINING_SCENES: fingerprints, "scenes": self._scenes, "recipe": self._spec}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._scenes, self._spec = list(state_dict["scenes"]), state_dict["recipe"]

    def _training_scenes(self, shards: Shards) -> list[str]:
        """Return the scenes of the training split in the dataset; a resumed run keeps the scenes it started with.

        Raises:
            UserError: if there is no such scene, a scene of a resumed run is missing, or the views of a resumed run
                were written with another specification.
        """
        if self._scenes:
            if self._spec != shards.spec:
                raise UserError(
                    f"data.shards: got views in {shards.place} with the specification {shards.spec}, expected "
                    f"{self._spec}, with which this run started; resume with that dataset, or start a new run"
                )
            if missing := [scene for scene in self._scenes if scene not in shards.scenes]:
                raise UserError(
                    f"data.shards: got {shards.place} without {first_of(missing)}, expected all scenes with which "
                    "this run started; write them again, or start a new run"
                )
            return self._scenes
        requested = self.observer.source.scenes("train")
        scenes = [scene for scene in requested if scene in shards.scenes]
        if not scenes:
            raise UserError(
                f"data.shards: got {first_of(list(shards.scenes))} in {shards.place}, expected scenes of the "
                f"training split: {first_of(requested)}; use the scene source with which the shards were written"
            )
        if len(scenes) < len(requested):
            count = len(requested) - len(scenes)
            log.warning(
                "data.shards: %d of the %d training scenes are not in the dataset", count, len(requested)
            )
        if ignored := len(shards.scenes) - len(scenes):
            log.warning(
                "data.shards: %d scenes of the dataset are not in the training split and are ignored", ignored
            )
        return scenes

"""Training views streamed out of a corpus (imagination.data.corpus), in a folder or behind a URL."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from imagination.cache import decode
from imagination.data.corpus import INDEX, as_read, chunk_name, describe, difference, prepare_litdata
from imagination.data.datamodule import SceneData
from imagination.errors import UserError
from imagination.ranks import rank, ranks
from imagination.views.collector import Stream, Views, concatenate
from imagination.views.view import Observer


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


class Shards:
    """A corpus to read from.

    Args:
        place: folder or URL (s3://…, gs://…).
        cache: folder for chunks of a URL.
        cache_size: most that is kept there, e.g. "20GB".

    Raises:
        UserError: if there is no corpus.
    """

    def __init__(self, place: str, cache: str, cache_size: str) -> None:
        prepare_litdata()
        from litdata import StreamingDataset

        self.place = place
        remote = "://" in place
        if not remote and not (Path(place) / INDEX).is_file():
            raise UserError(
                f"data.shards: got {place}, where there is no {INDEX}; expected a folder that "
                "python -m imagination.render +shards=… wrote, or a URL of one"
            )
        own = Path(cache) / hashlib.sha256(place.encode()).hexdigest()[:16]
        try:
            if remote:
                self._items = StreamingDataset(place, cache_dir=str(own), max_cache_size=cache_size)
                len(self._items)  # fetches the index
            for index in own.rglob(INDEX) if remote else [Path(place) / INDEX]:
                check_index(json.loads(index.read_text()), None if remote else Path(place))
            if not remote:
                self._items = StreamingDataset(place)
            about = json.loads(bytes(self._items[0]))
            self.group: int = int(about["group"])
            self.homes: dict[str, int] = {str(home): int(count) for home, count in about["homes"].items()}
            self.views: dict[str, Any] = about["views"]
        except UserError:
            raise
        except (RuntimeError, ValueError, LookupError, TypeError, OSError, AttributeError) as error:
            raise UserError(f"data.shards: {place} cannot be read ({error}); write it again") from error
        self._first = dict(zip(self.homes, np.cumsum([1, *self.homes.values()]).tolist(), strict=False))

    def read(self, home: str, number: int) -> Views:
        """One group of views of a home.

        Raises:
            UserError: if it is damaged or cannot be fetched.
        """
        try:
            return decode(bytes(self._items[self._first[home] + number]))
        except Exception as error:  # litdata raises anything on a chunk that is cut off
            raise UserError(
                f"data.shards: item {number} of {home} in {self.place} cannot be read ({error}); if it is damaged, "
                f"remove {chunk_name(home)} and write it again"
            ) from error

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


class ShardCollector:
    """Collections of training views out of shards, in place of rendering them; see `Collector`.

    So many homes as are looked at in parallel are open at once, and read through before the next: a chunk is fetched
    once a lap. Which views a collection gets depends on the seed and its number alone.

    Args:
        shards: to read from.
        homes: this process's own.
        seed: of the run.
        parallel_scenes: homes in one collection.
        steps: views of each of them.

    Raises:
        UserError: if the views do not divide into collections.
    """

    def __init__(
        self, shards: Shards, homes: Sequence[str], seed: int, parallel_scenes: int, steps: int
    ) -> None:
        self.shards, self.homes, self.seed = shards, list(homes), seed
        self.parallel_scenes, self.steps = parallel_scenes, steps
        items = min((shards.homes[home] for home in homes), default=0)
        if not items or steps % shards.group or steps // shards.group > items:
            raise UserError(
                f"data.shards: got {len(self.homes)} homes of {items} x {shards.group} views, expected at least one "
                f"home and collections of scale.update_interval = {steps} views of each; write them with that interval"
            )
        self._items_each = steps // shards.group
        self._collections = items // self._items_each  # out of the same homes
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
            lap, place = divmod(window * self.parallel_scenes + slot, len(self.homes))
            home = self.homes[self._shuffled(len(self.homes), lap)[place]]
            order = self._shuffled(self.shards.homes[home], lap, crc32(home.encode()))
            chosen = order[turn * self._items_each : (turn + 1) * self._items_each]
            parts += [self.shards.read(home, number) for number in chosen]
        return concatenate(parts)

    def _shuffled(self, count: int, *seed: int) -> list[int]:
        rng = np.random.default_rng([self.seed, Stream.SHARDS, *seed])
        order: list[int] = rng.permutation(count).tolist()
        return order


class ShardData(SceneData):
    """Training views streamed from shards; those of validation and test as in `SceneData`.

    Args:
        shards: folder or URL that `python -m imagination.render +shards=…` wrote.
        shard_cache: folder for chunks of a URL.
        shard_cache_size: most that is kept there.
        others: see `SceneData`.
    """

    def __init__(self, shards: str, shard_cache: str, shard_cache_size: str, **others: Any) -> None:
        super().__init__(**others)
        self._where = shards, shard_cache, shard_cache_size
        self._collector: ShardCollector | None = None

    def setup(self, stage: str) -> None:
        if stage == "fit":
            self.survey("val")  # training needs no truth: it is in the views
        else:
            super().setup(stage)

    def collector(self, steps: int) -> ShardCollector:  # type: ignore[override]  # start and views_per_collection alike
        if self._collector is None:
            shards = Shards(*self._where)
            shards.check(self.observer)
            homes = list(shards.homes)[rank() :: ranks()]
            share = self.parallel_scenes // ranks()
            self._collector = ShardCollector(shards, homes, self.seed, share, steps)
        return self._collector

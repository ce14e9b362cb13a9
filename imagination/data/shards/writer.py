"""Writer of a dataset of views as litdata shards, scene by scene.

An item is a group of views of one scene, encoded as in the cache; the items of a scene form one chunk. Item 0 describes
the dataset: the settings of its views and the number of items of each scene. Each scene is written completely or not at
all, as a chunk and a record file, so that any number of jobs can write to one folder and resume interrupted jobs.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, NamedTuple
from zlib import crc32

from imagination.utils.atomic_io import remove_parts, replacing, write_text
from imagination.utils.cache import code_version, encode
from imagination.utils.cache_key import as_plain
from imagination.utils.errors import (
    CannotWriteError,
    UserError,
    WorkerDiedError,
    check_range,
    first_of,
    require_extra,
)
from imagination.utils.file_lock import lock, locked_file
from imagination.utils.file_names import file_name
from imagination.views.collector import PoseSampler, render_views
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream
from imagination.views.scene_workers import ScenePool

log = logging.getLogger(__name__)

INDEX = "index.json"
"""Name of the file in which litdata lists the chunks."""

ABOUT = "chunk--about.bin"
"""Name of the chunk that holds only the description of the dataset; no file name of a scene begins with a hyphen."""

MAX_BYTES = 2**32 - 2**20
"""Maximum size of a chunk, bytes: litdata's offsets have 32 bits."""

LOCK, WORK = ".index.lock", ".work.lock"
"""Names of the lock files of the job that writes the index (exclusive) and of the jobs that write scenes (shared)."""


@dataclass(frozen=True)
class ShardSpec:
    """Specification of the views that are written for each scene.

    Attributes:
        sampler: sampler of poses.
        seed: seed of poses and sensor noise.
        views: number of views per scene.
        group: number of views in an item.

    Raises:
        UserError: if the number of views is out of range or no multiple of `group`.
    """

    sampler: PoseSampler
    seed: int
    views: int
    group: int

    def __post_init__(self) -> None:
        check_range("views", self.views, 1, 10_000_000, "views per scene")
        if self.views % self.group:
            raise UserError(
                f"views: got {self.views} per scene, expected a multiple of "
                f"callbacks.replay_buffer.update_interval = {self.group}"
            )

    def view_settings(self, observer: Observer) -> dict[str, Any]:
        """Return the settings that all views of a dataset have in common."""
        program = {"program": code_version()[:12]}  # the code that renders and projects
        return json_round_trip({**describe(observer), **as_plain(self), **program})


class Record(NamedTuple):
    """Record of a written scene.

    Attributes:
        scene: name of the scene.
        fingerprint: fingerprint of the scene.
        made_with: settings that the views share with those of the other scenes.
        items: number of items.
        chunk: entry of the chunk in litdata's index.
    """

    scene: str
    fingerprint: str
    made_with: dict[str, Any]
    items: int
    chunk: dict[str, Any]


def read_records(folder: Path, observer: Observer, spec: ShardSpec) -> dict[str, Record]:
    """Return the records of the written scenes by name; log and skip those that cannot be read.

    Raises:
        UserError: if a scene was rendered with other settings, since one description applies to the whole dataset.
    """
    expected, records = spec.view_settings(observer), {}
    for path in sorted(folder.glob("*.record.json")):
        try:
            record = _checked(Record(**json.loads(path.read_text())))
            written = (folder / chunk_name(record.scene)).is_file()
        except (OSError, ValueError, TypeError, RecursionError) as error:
            log.warning("shards: %s cannot be read (%s); its scene is treated as not written", path, error)
            continue
        if mismatch := first_difference(record.made_with, expected):
            raise UserError(
                f"shards: got views of {record.scene} in {folder} that were rendered with {mismatch}; write to "
                "another folder, or remove this one"
            )
        if written:
            records[record.scene] = record
    return records


def _checked(record: Record) -> Record:
    """Return a record after checking the types of its fields.

    Raises:
        ValueError: if a field has another type.
    """
    fields = zip(record, (str, str, dict, int, dict), strict=True)
    if not all(isinstance(value, kind) for value, kind in fields) or "entry" not in record.chunk:
        raise ValueError("it holds other fields than a record")
    return record


def unwritten(folder: Path, observer: Observer, scenes: Sequence[str], spec: ShardSpec) -> list[str]:
    """Return those of the scenes that are not written yet.

    Raises:
        UserError: if the folder holds scenes that were rendered with other settings, or other scenes of these names.
    """
    records = read_records(folder, observer, spec)
    written = [scene for scene in scenes if scene in records]
    if changed := [scene for scene in written if records[scene].fingerprint != observer.fingerprint(scene)]:
        raise UserError(
            f"shards: got scenes that differ from those of the same names in {folder} ({first_of(changed)}); write to "
            "another folder, use the scene source of that folder, or remove "
            f"{_record_path(folder, changed[0]).name} to write that scene again"
        )
    return [scene for scene in scenes if scene not in records]


@contextmanager
def at_work(folder: Path) -> Iterator[None]:
    """Mark a folder as being written to; the first job to enter and the last to leave remove incomplete files."""
    with open(folder / WORK, "a") as file:
        _remove_incomplete(folder, file)
        lock(file, shared=True)
        try:
            yield
        finally:
            _remove_incomplete(folder, file)


def _remove_incomplete(folder: Path, file: IO[str]) -> None:
    with suppress(BlockingIOError):  # other jobs are writing
        lock(file, wait=False)
        remove_parts(folder)


def write_scenes(
    observer: Observer, scenes: Sequence[str], folder: Path, spec: ShardSpec, workers: int
) -> Generator[tuple[str, str], None, None]:
    """Write scenes, one at a time in each worker; yield each name with an error message, empty on success.

    A scene fails if its worker is killed, e.g. when memory runs out. A new worker then writes the remaining scenes.

    Raises:
        UserError: if the number of workers is out of range, or the folder cannot be written to.
    """
    check_range("data.workers", workers, 0, 1024)
    pending = list(reversed(scenes))
    idle = [ScenePool(observer, min(workers, 1)) for _ in range(max(workers, 1))]
    running: dict[Future[str], tuple[str, ScenePool]] = {}
    try:
        while pending or running:
            while pending and idle:
                scene, pool = pending.pop(), idle.pop()
                running[pool.submit(try_scene, scene, folder, spec)] = scene, pool
            for task in wait(running, return_when=FIRST_COMPLETED).done:
                scene, pool = running.pop(task)
                try:
                    problem = task.result()
                except WorkerDiedError:
                    pool.close()
                    pool = ScenePool(observer, 1)
                    problem = "its worker process was killed (possibly out of memory); try again with data.workers=1"
                except CannotWriteError:
                    pool.close()
                    raise
                idle.append(pool)
                yield scene, problem
    finally:
        for pool in [*idle, *(pool for _, pool in running.values())]:
            pool.close()


def write_scene(observer: Observer, scene: str, folder: Path, spec: ShardSpec) -> None:
    """Render the views of a scene and write its chunk, then its record; runs in a worker process.

    Raises:
        UserError: if the views do not fit into a chunk.
    """
    seed = (spec.seed, Stream.SHARDS, crc32(scene.encode()))
    items, groups, total = [], spec.views // spec.group, 0
    try:
        for group in range(groups):
            items.append(encode(render_views(observer, scene, spec.sampler, (*seed, group), spec.group)))
            total += len(items[-1])
            estimate = total * groups / len(items)
            if estimate > MAX_BYTES:  # extrapolated, so that the error is raised early
                raise UserError(
                    f"views: got {spec.views} per scene, about {estimate / 1e9:.1f} GB, expected at most "
                    f"{MAX_BYTES / 1e9:.1f} GB, the capacity of a chunk; write fewer views of more scenes"
                )
    finally:
        observer.forget(scene)  # otherwise a worker would hold every scene of the dataset in the end
    chunk = _write_chunk(folder / chunk_name(scene), items)
    record = Record(scene, observer.fingerprint(scene), spec.view_settings(observer), len(items), chunk)
    write_text(_record_path(folder, scene), json.dumps(record._asdict()))


def try_scene(observer: Observer, scene: str, folder: Path, spec: ShardSpec) -> str:
    """Write a scene and return an error message, empty on success.

    Raises:
        CannotWriteError: if the folder cannot be written to, since further scenes would be rendered in vain.
    """
    try:
        write_scene(observer, scene, folder, spec)
    except CannotWriteError:
        raise
    except Exception as error:  # a scene source may raise any error, which does not concern other scenes
        return f"{type(error).__name__}: {error}"
    return ""


def write_index(folder: Path, observer: Observer, spec: ShardSpec) -> dict[str, Any]:
    """Write the index of all scenes written so far and return the description of the dataset.

    Raises:
        UserError: if no scene was written, or the folder holds scenes that were rendered with other settings.
    """
    with locked_file(folder / LOCK):  # otherwise a job that listed fewer scenes might write its list last
        records = read_records(folder, observer, spec)
        if not records:
            raise UserError(
                f"shards: got no written scene in {folder}, expected at least one; see the messages above"
            )
        scenes = {
            scene: {"items": record.items, "fingerprint": record.fingerprint}
            for scene, record in records.items()
        }
        about = {"views": describe(observer), "recipe": as_plain(spec), "scenes": scenes}
        first = _write_chunk(folder / ABOUT, [json.dumps(about).encode()])
        chunks = [first["entry"], *(record.chunk["entry"] for record in records.values())]
        # litdata recognises by this time alone that its cached copy of a URL is out of date
        index = {"chunks": chunks, "config": first["config"], "updated_at": str(time.time())}
        write_text(folder / INDEX, json.dumps(index))
    return about


def describe(observer: Observer) -> dict[str, Any]:
    """Return the settings that the views of every scene depend on."""
    parts = ("camera", "sensor", "ego", "obstacles", "ground_truth_spec")
    settings = {part: as_plain(getattr(observer, part)) for part in parts}
    return {**settings, "categories": observer.categories.labels}


def json_round_trip(description: dict[str, Any]) -> dict[str, Any]:
    """Return a description as it is read back from a JSON file."""
    result: dict[str, Any] = json.loads(json.dumps(description))
    return result


def first_difference(actual: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    """Return the first part of a description that differs, with both values; an empty string if none differs."""
    for part, value in expected.items():
        if actual.get(part) != value:
            return f"{part} {actual.get(part)}, expected {value}"
    return ""


def prepare_litdata() -> None:
    """Check that litdata is installed and switch off its version check.

    Raises:
        UserError: if litdata is not installed.
    """
    require_extra("litdata", "shards")
    # the version check queries PyPI, which takes 30 s without a network
    os.environ.setdefault("LITDATA_DISABLE_VERSION_CHECK", "1")


def chunk_name(scene: str) -> str:
    """Return the file name of a scene's chunk."""
    return f"chunk-{file_name(scene)}.bin"


def _record_path(folder: Path, scene: str) -> Path:
    return folder / f"{file_name(scene)}.record.json"


def _write_chunk(path: Path, items: Sequence[bytes]) -> dict[str, Any]:
    """Write items as one chunk and return its entry in litdata's index and the index's configuration."""
    prepare_litdata()
    from litdata.streaming.writer import BinaryWriter

    with replacing(path) as temporary, TemporaryDirectory(dir=temporary.parent) as scratch:
        writer = BinaryWriter(scratch, chunk_size=len(items) + 1)
        for number, item in enumerate(items):
            writer[number] = item
        writer.done()
        writer.merge(1)
        index = json.loads((Path(scratch) / INDEX).read_text())
        (entry,) = index["chunks"]
        os.replace(Path(scratch) / entry["filename"], temporary)
    return {"entry": {**entry, "filename": path.name}, "config": index["config"]}

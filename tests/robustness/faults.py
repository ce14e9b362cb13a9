"""Faults injected into training, mapping and rendering, and checks of the results."""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from imagination.data.shards.writer import ABOUT, INDEX
from imagination.deployment.export import export
from imagination.runs.checkpoint import Checkpoint, read_state
from imagination.runs.folder import BEST, COMPOSED, CONFIG, LAST
from imagination.utils.atomic_io import PART
from tests.conftest import ROOT
from tests.helpers.checkpoints import make_checkpoint, samples
from tests.helpers.robot import corridor_path, drive, record_tum
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import CAMERA

Result = dict[str, bytes]
"""Contents of the files of a run, by name."""

Progress = dict[str, int]
"""Finished units of work, and their times, ns."""

FRAMES = 200
"""Number of frames of the recorded drive."""

SCENES = 3
"""Number of scenes of the dataset of shards."""

TICK = 0.005
"""Interval at which a process is polled, seconds."""

TIMEOUT = 300.0
"""Time after which a process counts as hanging, seconds."""

PARTIAL = f"*{PART}"
"""Pattern of partially written files in run folders and the cache."""


@dataclass(frozen=True)
class Job:
    """Command whose result must be identical to the bit after any fault.

    Attributes:
        name: name of the command.
        arguments: arguments of the command.
        result: path of the result relative to the working folder; its siblings are results of other runs.
        read: reader of the existing part of a result; it refuses partially written files.
        cached: whether the command reads and fills the cache.
        progress: reader of the work that a resumed command must not repeat.
        repeated: list of the work in the progress that a resumed command repeated.
    """

    name: str
    arguments: tuple[str, ...]
    result: str
    read: Callable[[Path], Result]
    cached: bool
    progress: Callable[[Path], Progress] = lambda path: {}
    repeated: Callable[[Path, Progress], list[str]] = lambda path, progress: []


def training_progress(run: Path) -> Progress:
    """Return the number of training steps in the last checkpoint."""
    if not (run / LAST).is_file():
        return {}
    return {str(read_state(run / LAST)["global_step"]): time.time_ns()}


def repeated_steps(run: Path, progress: Progress) -> list[str]:
    """Return the steps before a checkpoint that were logged after it."""
    return [
        str(event.step)
        for steps, saved_at in progress.items()
        for file in (run / "tensorboard").rglob("events.*")
        if file.stat().st_mtime_ns > saved_at
        for event in EventFileLoader(str(file)).Load()
        if event.step < int(steps) and any(value.tag.startswith("train/") for value in event.summary.value)
    ]


def shards_progress(shards: Path) -> Progress:
    """Return the modification times of the scenes written so far."""
    return {path.name: path.stat().st_mtime_ns for path in shards.glob("*.record.json")}


def repeated_scenes(shards: Path, progress: Progress) -> list[str]:
    """Return the scenes that were written again."""
    current = shards_progress(shards)
    return [name for name, time in progress.items() if current.get(name) != time]


def read_training(run: Path) -> Result:
    """Return tables and weights, or nothing before the run has ended."""
    states = {path: read_state(run / path) for path in (LAST, BEST) if (run / path).is_file()}
    tables = [run / "tables" / name for name in ("mapping.csv", "ego.csv")]
    if not all(table.is_file() for table in tables):
        return {}
    weights = {name: value.numpy().tobytes() for name, value in states[LAST]["state_dict"].items()}
    return weights | {table.name: table.read_bytes() for table in tables}


def read_map(run: Path) -> Result:
    """Return all files except those with dates or paths."""
    files = [path for path in run.iterdir() if path.is_file()]
    return {path.name: path.read_bytes() for path in files if path.name not in ("run.log", CONFIG)}


def read_shards(shards: Path) -> Result:
    """Return chunks and records, and once all scenes exist, the description and the index without its date."""
    files = {path.name: path.read_bytes() for kind in ("bin", "json") for path in shards.glob(f"*.{kind}")}
    index = json.loads(files.pop(INDEX, "{}")) | {"updated_at": ""}
    if len(index.get("chunks", [])) == SCENES + 1:
        return files | {INDEX: json.dumps(index).encode()}
    return {name: content for name, content in files.items() if name != ABOUT}


def jobs(folder: Path) -> list[Job]:
    """Return the jobs; write a recorded drive and a unit for mapping into the folder."""
    scene = tiny_room()
    record_tum(folder / "tum", list(drive(scene, CAMERA, corridor_path(scene.free_space, FRAMES))), CAMERA)
    unit = folder / "chair.onnx"
    export([Checkpoint.read(make_checkpoint(folder / "chair.ckpt"))], unit, "onnx", "float32", samples(1))
    camera = "recording.camera.values.colour={width:48,height:48,fx:24,fy:24,cx:23.5,cy:23.5}"
    epochs = "trainer.max_epochs=4", "trainer.check_val_every_n_epoch=2"
    train = "+experiment=chair_unet", "scale=test", *epochs, "data.workers=1"
    render = "scale=test", f"data.splits.train={SCENES}", "data.workers=1", "views=16"
    shards = "outputs/render/shards"
    mapping = "recording=tum", f"recording.path={folder / 'tum'}", f"unit={unit}", camera
    return [
        Job(
            "train",
            train,
            "outputs/chair_unet/latest",
            read_training,
            True,
            training_progress,
            repeated_steps,
        ),
        Job("map", mapping, "outputs/map/latest", read_map, cached=False),
        Job(
            "prepare_shards",
            (*render, f"shards={shards}"),
            shards,
            read_shards,
            True,
            shards_progress,
            repeated_scenes,
        ),
    ]


class Ended(NamedTuple):
    """Exit code and error output of a process."""

    code: int
    stderr: str


Watch = Callable[[int], None]
"""Function called every few milliseconds with the id of a running process."""


class Undisturbed(NamedTuple):
    """Reference run without a fault.

    Attributes:
        folder: working folder with the cache.
        result: expected result of every run.
        seconds: duration, seconds.
        largest: size of the largest file, bytes.
        used: disk space, bytes.
    """

    folder: Path
    result: Result
    seconds: float
    largest: int
    used: int


class Faults:
    """Injector of faults; each method injects one fault into a job in a new folder and checks the result.

    Args:
        folder: folder of the undisturbed runs.
        seed: seed of the times of faults.

    Attributes:
        count: number of events by fault and job.
        peaks: peak memory of the processes of each job in this round, MB.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.random = folder, random.Random(seed)
        self.count: Counter[tuple[str, str]] = Counter()
        self.peaks: dict[str, float] = {}
        self.undisturbed: dict[str, Undisturbed] = {}

    def run_undisturbed(self, job: Job) -> None:
        """Run the job without a fault and store the expected result."""
        folder, begin = self.folder / job.name, time.monotonic()
        ended = self._wait(job, self._start(job, folder))
        seconds, result = time.monotonic() - begin, job.read(folder / job.result)
        assert ended.code == 0 and result, ended
        files = [path.stat() for path in folder.rglob("*") if path.is_file()]
        largest, used = max(file.st_size for file in files), sum(512 * file.st_blocks for file in files)
        self.undisturbed[job.name] = Undisturbed(folder, result, seconds, largest, used)

    def killed(self, job: Job, folder: Path) -> None:
        """Kill the job at a random time, while a file is written, and after finished work; resume it each time."""
        seconds, result = self.undisturbed[job.name].seconds, folder / job.result

        def later() -> bool:
            return time.monotonic() > moment

        def halfway() -> bool:
            return bool(set(folder.rglob(PARTIAL)) - before)

        def current_progress() -> Progress:
            return job.progress(result) if result.is_dir() else {}

        def advanced() -> bool:
            return bool(set(current_progress()) - set(progress))

        order = [advanced, later, lambda: later() and halfway()]
        for ready in order[:: -1 if self.count["killed", job.name] % 2 else 1]:
            moment = time.monotonic() + self.random.uniform(0, seconds)
            before, progress = set(folder.rglob(PARTIAL)), current_progress()
            ended = self._wait(job, self._start(job, folder), killer(ready))
            assert ended.code in (0, -signal.SIGKILL), ended.stderr
            self.count["kills", job.name] += ended.code != 0
            self.count["halfway", job.name] += halfway()
            self._check_not_repeated(job, result, progress)
            self._check_sound(job, folder)
        progress = current_progress()
        self._finish(job, folder)
        self._check_not_repeated(job, result, progress)

    def limited(self, job: Job, folder: Path) -> None:
        """Limit the size of files: the job ends with one message, and resumes without the limit."""
        self._check_refused(job, folder, self._less(self.undisturbed[job.name].largest, 0.01))
        self._finish(job, folder)

    def full_disk(self, job: Job, folder: Path) -> None:
        """Use a disk that is too small: the job ends with one message, and resumes with more space."""
        # on a smaller disk even run.log cannot be written, and a traceback is printed
        size = self._less(self.undisturbed[job.name].used, 0.1)
        with disk(folder, size):
            self._check_refused(job, folder)
            subprocess.run(["mount", "-o", "remount,size=1g", folder], check=True)
            self._finish(job, folder)

    def damaged(self, job: Job, folder: Path) -> None:
        """Damage all unread entries of the cache once the job has begun to read it."""
        began, damaged, cache = time.time(), False, self.undisturbed[job.name].folder / "cache"

        def damage(process: int) -> None:
            nonlocal damaged
            entries = [] if damaged else sorted(cache.rglob("*.bin"))
            unread = [path for path in entries if path.stat().st_mtime < began]  # reading sets the time
            if len(unread) < len(entries):
                damaged = True
                for path in unread:
                    self._damage(path)

        ended = self._finish(job, folder, cache=cache, watch=damage)
        self.count["entries", job.name] += ended.stderr.count("is damaged")

    def shared(self, job: Job, folder: Path) -> None:
        """Run two processes that fill one empty cache; two renderings also write one dataset of shards."""
        processes = [self._start(job, folder) for _ in range(2)]
        for process in processes:
            ended = self._wait(job, process)
            assert ended.code == 0, ended.stderr
        for result in self._check_sound(job, folder):
            self._check_complete(job, result)

    def _damage(self, path: Path) -> None:
        """Truncate a file, or flip one of its bits."""
        content = bytearray(path.read_bytes() or b"0")
        position = self.random.randrange(len(content))
        content[position] ^= 1 << self.random.randrange(8)
        path.write_bytes(content[:position] if self.random.random() < 0.5 else content)

    def _check_not_repeated(self, job: Job, result: Path, progress: Progress) -> None:
        """Check that a resumed command repeated no finished work."""
        if progress:
            repeated = job.repeated(result, progress)
            assert not repeated, f"{job.name} repeated finished work: {repeated} of {progress}"
            self.count["resumed", job.name] += 1

    def _less(self, size: int, minimum: float) -> int:
        """Draw a size that is too small, log-uniformly down to a fraction of the size."""
        return int(size * minimum ** self.random.uniform(0.1, 1))

    def _check_refused(self, job: Job, folder: Path, limit: int | None = None) -> None:
        """Check that a job that cannot write ends with one message and leaves valid files only."""
        ended = self._wait(job, self._start(job, folder, limit=limit))
        errors = [line for line in ended.stderr.splitlines() if line.startswith("error: ")]
        assert (ended.code, len(errors)) == (2, 1), ended
        assert not list(folder.rglob(PARTIAL)), "a partially written file is left"
        assert "Traceback" not in ended.stderr, ended
        assert "could not write" in ended.stderr or "cannot write" in ended.stderr, ended
        self._check_sound(job, folder)

    def _start(
        self, job: Job, folder: Path, *, limit: int | None = None, cache: Path | None = None
    ) -> "subprocess.Popen[bytes]":
        """Start or resume a job in its folder; the default cache is in the folder."""
        folder.mkdir(exist_ok=True)
        resumable = (folder / job.result / COMPOSED).is_file()  # training only
        arguments = ["resume=latest"] if resumable else [*job.arguments]
        arguments += [f"paths.cache={cache or folder / 'cache'}"]
        process = subprocess.Popen(
            [sys.executable, "-m", f"imagination.{job.name}", *arguments],
            env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        if limit is not None:
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
        return process

    def _wait(
        self, job: Job, process: "subprocess.Popen[bytes]", watch: Watch = lambda process: None
    ) -> Ended:
        """Wait for a process of a job and record its peak memory."""
        end, peak = time.monotonic() + TIMEOUT, 0.0
        try:
            while time.monotonic() < end:
                try:
                    stderr = process.communicate(timeout=TICK)[1].decode()
                    self.peaks[job.name] = max(self.peaks.get(job.name, 0.0), peak)
                    return Ended(process.returncode, stderr)
                except subprocess.TimeoutExpired:
                    peak = max(peak, memory(process.pid))
                    watch(process.pid)
            raise AssertionError(f"{job.name} hangs")
        finally:
            if process.returncode is None:
                os.killpg(process.pid, signal.SIGKILL)

    def _finish(
        self, job: Job, folder: Path, *, cache: Path | None = None, watch: Watch = lambda process: None
    ) -> Ended:
        """Run the job to its end and check that its result is that of the undisturbed run."""
        ended = self._wait(job, self._start(job, folder, cache=cache), watch)
        assert ended.code == 0 and "Traceback" not in ended.stderr, ended
        self._check_sound(job, folder)
        self._check_complete(job, job.read(folder / job.result))
        return ended

    def _check_sound(self, job: Job, folder: Path) -> list[Result]:
        """Check that all existing files equal those of the undisturbed run, and return the results."""
        expected = self.undisturbed[job.name].result
        results = [job.read(path) for path in (folder / job.result).parent.glob("*") if path.is_dir()]
        wrong = {
            name for result in results for name, content in result.items() if expected.get(name) != content
        }
        assert not wrong, f"{job.name} in {folder}: {sorted(wrong)} differ from the undisturbed run"
        return results

    def _check_complete(self, job: Job, result: Result) -> None:
        """Check that a result is complete and equals that of the undisturbed run."""
        expected = self.undisturbed[job.name].result
        assert result == expected, f"{job.name}: got {sorted(result)}, expected {sorted(expected)}"


def killer(ready: Callable[[], bool]) -> Watch:
    """Return a function that kills a process and its workers as soon as `ready` is true."""

    def kill(process: int) -> None:
        if ready():
            os.killpg(process, signal.SIGKILL)

    return kill


def memory(process: int) -> float:
    """Return the memory of a process and its descendants, MB; 0 if it has ended."""
    folder = Path(f"/proc/{process}")
    try:
        pages = int((folder / "statm").read_text().split()[1])
        children = [
            int(child) for file in folder.glob("task/*/children") for child in file.read_text().split()
        ]
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return pages * resource.getpagesize() / 1e6 + sum(map(memory, children))


@contextmanager
def disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a file system of a size in bytes in memory.

    Raises:
        subprocess.CalledProcessError: if the user may not mount it.
    """
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)

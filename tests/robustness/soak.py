"""Soak test: `make soak`, or `python -m tests.robustness.soak [minutes=20] [seed=0]`.

It injects faults in rounds. Training, mapping and rendering are killed, run out of disk, read damaged cache entries and
share a cache; each must end with the result of an undisturbed run. Meanwhile a thread of this process maps and renders;
its result must not change. The memory of all processes must not grow.
"""

import hashlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import date
from pathlib import Path
from threading import Event, get_native_id
from types import TracebackType

import numpy as np

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, project_depth
from imagination.mapping.mapper import Mapper
from imagination.mapping.update_rules import MovingAverage
from imagination.runs.checkpoint import read_state
from imagination.runs.folder import LAST
from imagination.scenes.renderer import Renderer
from imagination.views.pose_samplers import sample_poses
from tests.conftest import ROOT
from tests.helpers.rooms import tiny_room
from tests.robustness.faults import Faults, disk, jobs, memory
from tests.robustness.page import write_part

MAX_GROWTH = 1.1
"""Maximum ratio of the memory in the last round of faults to that in the first."""

VIEWS = 300
"""Number of views in a pass of mapping and rendering in this process."""

THIS_PROCESS = "this process"

TEST = "scale=test", "data.workers=1"
EPOCHS = "trainer.max_epochs=1000000", "trainer.check_val_every_n_epoch=200"
LONG_TRAINING = "train", "+experiment=chair_unet", *TEST, *EPOCHS
LONG_RENDERING = "prepare_shards", "shards=shards", *TEST, "data.splits.train=9999", "views=16"
"""Commands that run in the background during all rounds."""

COLUMNS = {"train": "training", "map": "mapping", "prepare_shards": "rendering"}
"""Columns of the table by job."""

ROWS = (
    (
        "killed: times, kills, kills during a write; resumptions with finished work",
        ("killed", "kills", "halfway", "resumed"),
        "resumes with the same result; no finished work is repeated",
    ),
    ("limit on the size of files", ("limited",), "one message, code 2; same result without the limit"),
    ("disk too small", ("full_disk",), "one message, code 2; same result with more space"),
    ("cache entries damaged: times, entries read", ("damaged", "entries"), "rebuilt; same result"),
    ("two processes on one empty cache", ("shared",), "same result twice"),
)
"""Rows of the table: fault, its counts, and outcome."""


class MappingThread:
    """Thread that renders, projects and registers the same views repeatedly.

    Attributes:
        passes: number of passes so far.
        peak: peak memory of this process since the last reset, MB.
    """

    def __init__(self) -> None:
        self.passes, self.peak = 0, 0.0
        self.expected = self._pass()
        self._stop = Event()
        self._thread = ThreadPoolExecutor(1)

    def __enter__(self) -> "MappingThread":
        self._task = self._thread.submit(self._run)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.shutdown()

    def check(self) -> None:
        """Raise the error of the thread, if any."""
        if self._task.done():
            self._task.result()

    def _run(self) -> None:
        os.setpriority(os.PRIO_PROCESS, get_native_id(), 10)  # lower priority of this thread than of the jobs
        while not self._stop.is_set():
            assert self._pass() == self.expected, "the result of mapping and rendering changed"
            self.passes += 1
            self.peak = max(self.peak, resident())

    def _pass(self) -> str:
        """Map all views, and return a hash of the images and the map."""
        room, digest = tiny_room(), hashlib.sha256()
        renderer, camera = Renderer(room.mesh, room.lighting), Camera.from_degrees(64, 64, 90.0, 1.25)
        ego = EgoGrid.of_extent(3.72, 0.06)
        mapper = Mapper(Grid.centred(20.0, 0.06), ego, ["chair"], MovingAverage(0.9))
        for pose in sample_poses(room.free_space, VIEWS, np.random.default_rng(0)):
            image = renderer.render(camera, camera.to_world(pose, 0.0))
            view = project_depth(image.depth, camera, ego, Band(0.2, 1.5))
            mapper.register(view.occupied[None].astype(np.float32), view.seen[None], Pose(*pose))
            digest.update(image.rgb.tobytes() + image.depth.tobytes() + image.instance.tobytes())
        assert mapper.written.any() and mapper.probabilities.any()
        digest.update(mapper.probabilities.tobytes() + mapper.written.tobytes())
        return digest.hexdigest()


class BackgroundCommand:
    """Command that runs with low priority during the whole soak test.

    Args:
        name: name in messages.
        folder: working folder.
        command: name of the module and its arguments.
        progress: function that counts the finished steps in the folder.
    """

    def __init__(
        self, name: str, folder: Path, command: Sequence[str], progress: Callable[[Path], int]
    ) -> None:
        self.name, self.folder, self.command, self.progress = name, folder, command, progress
        self.steps: list[int] = []  # after each round of faults

    def begin(self) -> None:
        self.folder.mkdir()
        with open(self.folder / "stderr", "w") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, "-m", f"imagination.{self.command[0]}", *self.command[1:]],
                env=os.environ | {"PYTHONPATH": str(ROOT)},
                cwd=self.folder,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                start_new_session=True,
                preexec_fn=lambda: os.nice(15),
            )

    def sample(self) -> float:
        """Record the progress, and return the memory of all processes of the command, MB."""
        assert self.process.poll() is None, f"{self.name} has ended: {(self.folder / 'stderr').read_text()}"
        self.steps.append(self.progress(self.folder))
        return memory(self.process.pid)

    def end(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def epochs(folder: Path) -> int:
    """Return the number of finished epochs of the training in a folder."""
    checkpoint = folder / "outputs" / "chair_unet" / "latest" / LAST
    return int(read_state(checkpoint)["epoch"]) + 1 if checkpoint.is_file() else 0


def scenes(folder: Path) -> int:
    """Return the number of scenes of the dataset of shards in a folder."""
    return sum(1 for _ in folder.glob("shards/*.record.json"))


class Soak:
    """Soak test in a folder.

    Args:
        folder: folder of caches and outputs.
        seed: seed of the times of faults.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.faults, self.jobs, self.left_out = Faults(folder, seed), jobs(folder), []
        try:
            with disk(folder / "disk", 4096):
                self.mounts = True
        except (subprocess.CalledProcessError, FileNotFoundError) as error:
            self.mounts = False
            self.left_out.append(f"Small disks were not tested: {error}.")
        self.rounds: list[dict[str, float]] = []  # memory, MB
        for job in self.jobs:
            self.faults.run_undisturbed(job)
        self.background = [
            BackgroundCommand("one training", folder / "long_training", LONG_TRAINING, epochs),
            BackgroundCommand("one rendering", folder / "long_rendering", LONG_RENDERING, scenes),
        ]

    def run(self, minutes: float, mapping: MappingThread) -> None:
        """Inject faults in rounds until the time is over."""
        end = time.monotonic() + 60 * minutes
        for command in self.background:
            command.begin()
        try:
            while time.monotonic() < end:
                self.faults.peaks.clear()
                mapping.peak = 0.0
                self.round(mapping)
                background = {command.name: command.sample() for command in self.background}
                self.rounds.append({**self.faults.peaks, THIS_PROCESS: mapping.peak, **background})
        finally:
            for command in self.background:
                command.end()

    def round(self, mapping: MappingThread) -> None:
        """Inject each fault into each job once."""
        faults, folder = self.faults, self.faults.folder / "now"
        full = faults.full_disk if self.mounts and len(self.rounds) % 2 else faults.limited  # alternately
        for fault in (faults.killed, full, faults.damaged, faults.shared):
            for job in self.jobs:
                if job.cached or fault not in (faults.damaged, faults.shared):
                    begin = time.monotonic()
                    fault(job, folder)
                    print(f"{fault.__name__} {job.name}: {time.monotonic() - begin:.0f} s", flush=True)
                    faults.count[fault.__name__, job.name] += 1
                    shutil.rmtree(folder)
                    mapping.check()

    def check(self) -> None:
        """Check that memory did not grow, background commands made progress, and faults had an effect."""
        first, last = self.rounds[0], self.rounds[-1]
        changes = {name: f"{name}: {first[name]:.0f} to {last[name]:.0f} MB" for name in first}
        increased = [changes[name] for name in first if last[name] > MAX_GROWTH * first[name]]
        assert not increased, f"memory increased: {', '.join(increased)}"
        for command in self.background:
            steps = command.steps
            assert len(steps) == 1 or 0 < steps[0] < steps[-1], f"{command.name} made no progress: {steps}"
        cached = [job.name for job in self.jobs if job.cached]
        missing = [
            (event, job)
            for event in ("entries", "resumed")
            for job in cached
            if not self.faults.count[event, job]
        ]
        assert not missing, (
            f"no damaged entry was read, or no finished work was resumed: {missing}; check that the code, and with it "
            "the cache keys, did not change meanwhile"
        )

    def background_report(self, passes: int) -> list[str]:
        """Return lines on the mapping thread and the background commands."""
        first, last = self.rounds[0], self.rounds[-1]
        return [
            f"Meanwhile one process rendered and mapped the same {VIEWS} views {passes} times with identical images",
            f"and map; its memory was {first[THIS_PROCESS]:.0f} MB in the first round and "
            f"{last[THIS_PROCESS]:.0f} MB in the last. Background commands:",
            "",
            *(
                f"- {command.name}: {first[command.name]:.0f} MB with its workers after {command.steps[0]} "
                f"{command.progress.__name__}, {last[command.name]:.0f} MB after {command.steps[-1]}."
                for command in self.background
            ),
        ]

    def table(self) -> list[str]:
        """Return the table of faults by job, with the peak memory."""
        count, first, last = self.faults.count, self.rounds[0], self.rounds[-1]

        def cell(job: str, events: tuple[str, ...]) -> str:
            numbers = [str(count[event, job]) if (event, job) in count else "–" for event in events]
            return ", ".join(numbers) if count[events[0], job] else "–"

        memory = [f"{first[job]:.0f}, {last[job]:.0f}" if job in first else "–" for job in COLUMNS]
        rows = [
            ("fault", *COLUMNS.values(), "outcome"),
            ("---",) * 5,
            *((fault, *(cell(job, events) for job in COLUMNS), outcome) for fault, events, outcome in ROWS),
            (
                "peak memory in the first and the last round, MB",
                *memory,
                f"increases by less than {MAX_GROWTH - 1:.0%}",
            ),
        ]
        return ["| " + " | ".join(row) + " |" for row in rows]


def resident() -> float:
    """Return the resident memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def main(arguments: list[str]) -> None:
    """Run the soak test and write its results into docs/measured/reliability.md."""
    values = {"minutes": 20.0, "seed": 0.0}
    for key, _, value in (argument.partition("=") for argument in arguments):
        if key not in values:
            sys.exit(f"soak: got {key}, expected minutes=… or seed=…")
        values[key] = float(value)
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(Path(folder), int(values["seed"]))
        with MappingThread() as mapping:
            soak.run(values["minutes"], mapping)
        mapping.check()
    text = "\n".join(
        [
            f"{date.today()}: {values['minutes']:g} minutes, {len(soak.rounds)} rounds, seed {values['seed']:g}.",
            *soak.left_out,
            "",
            *soak.table(),
            "",
            *soak.background_report(mapping.passes),
        ]
    )
    print(text, *soak.rounds, sep="\n")
    soak.check()
    write_part("soak", text)


if __name__ == "__main__":
    main(sys.argv[1:])

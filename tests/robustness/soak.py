"""`make soak`, or `python -m tests.robustness.soak [minutes=20] [seed=0]`: faults, one after another, until time is up.

Training runs are killed, run out of disk, find damaged entries in the cache, share a cache with another run; each must
end with the tables and weights of an undisturbed run. Between them mapping and rendering go on in this process, whose
memory must stay flat.
"""

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from imagination.checkpoints import read_state
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, project_depth
from imagination.mapping.mapper import Mapper
from imagination.mapping.registration import MovingAverage
from imagination.scenes.renderer import Renderer
from imagination.views.poses import sample_poses
from tests.conftest import ROOT
from tests.robustness.page import write_part
from tests.rooms import tiny_room

JOB = ["+experiment=chair_unet", "scale=test", "scale.rounds=6", "scale.eval_every=2", "scale.workers=1"]
LIMITS = (20_000, 300_000, 3_000_000)
"""Bytes a file may have where the disk is to be full."""

FLAT = 1.1
"""How much the memory of mapping and rendering may grow over the whole soak, times."""


class Soak:
    """One soak in a folder of its own.

    Args:
        folder: for caches and outputs.
        seed: of the moments at which things break.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.random = folder, random.Random(seed)
        self.count: Counter[str] = Counter()
        self.resumed: list[int] = []  # rounds that were left when runs went on
        self.memory: list[float] = []
        self.truth = self._finish(self._start("reference"), "reference")

    def run(self, minutes: float) -> None:
        """Break things until time is up."""
        end = time.monotonic() + 60 * minutes
        faults: list[Callable[[Path], None]] = [self.killed, self.full_disk, self.damaged, self.shared]
        while time.monotonic() < end:
            for fault in faults:
                outputs = self.folder / f"{fault.__name__}_{self.count[fault.__name__]}"
                fault(outputs)
                self.count[fault.__name__] += 1
                shutil.rmtree(outputs, ignore_errors=True)
                self.map_and_render()

    def killed(self, outputs: Path) -> None:
        """SIGKILL at random moments, three times; each time the run goes on."""
        process = self._start(outputs.name)
        for _ in range(3):
            try:
                process.wait(self.random.uniform(1.0, 25.0))
                break
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            if not list(outputs.glob("chair_unet/latest/composed.yaml")):  # killed before there was a run
                process = self._start(outputs.name)
                continue
            last = outputs / "chair_unet" / "latest" / "checkpoints" / "last.ckpt"
            self.resumed.append(5 - read_state(last)["epoch"] if last.is_file() else 6)
            process = self._start(outputs.name, "resume=latest")
        self._same(process, outputs)

    def full_disk(self, outputs: Path) -> None:
        """No file may grow beyond a limit: the run must say so; without the limit it goes on."""
        process = self._start(outputs.name, limit=self.random.choice(LIMITS), cache=outputs / "cache")
        told = process.communicate()[1].decode()
        assert process.returncode == 2 and ("could not write" in told or "cannot write" in told), told
        assert "Traceback" not in told, told
        begun = list(outputs.glob("chair_unet/latest/composed.yaml"))
        self._same(self._start(outputs.name, *(["resume=latest"] if begun else [])), outputs)

    def damaged(self, outputs: Path) -> None:
        """Entries of the shared cache are cut and flipped while a run reads them."""
        entries = sorted((self.folder / "cache").rglob("*.bin"))
        process = self._start(outputs.name)
        for path in self.random.sample(entries, min(6, len(entries))):
            content = bytearray(path.read_bytes())
            place = self.random.randrange(len(content))
            content[place] ^= 1 << self.random.randrange(8)
            path.write_bytes(bytes(content[:place] if self.random.random() < 0.5 else content))
        self._same(process, outputs)

    def shared(self, outputs: Path) -> None:
        """Two runs fill one empty cache at once."""
        cache = outputs / "cache"
        both = [self._start(f"{outputs.name}/{name}", cache=cache) for name in "ab"]
        for process, name in zip(both, "ab", strict=True):
            self._same(process, outputs / name)

    def map_and_render(self, views: int = 300) -> None:
        """Render, project and register views; note the memory."""
        room = tiny_room()
        renderer, camera = Renderer(room.mesh, room.lighting), Camera.from_degrees(64, 64, 90.0, 1.25)
        ego = EgoGrid.of_extent(3.72, 0.06)
        mapper = Mapper(Grid.centred(20.0, 0.06), ego, ["chair"], MovingAverage(0.9))
        rng = np.random.default_rng(self.count.total())
        for pose in sample_poses(room.free_space, views, rng):
            image = renderer.render(camera, camera.to_world(pose, 0.0))
            seen = project_depth(image.depth, camera, ego, Band(0.2, 1.5)).seen
            mapper.register(seen[None].astype(np.float32), seen[None], Pose(*pose))
        assert mapper.probabilities.max() == 1 and mapper.written.any()
        self.memory.append(resident())

    def _start(
        self, name: str, *words: str, limit: int | None = None, cache: Path | None = None
    ) -> "subprocess.Popen[bytes]":
        """Start training, or go on with it."""

        def limited() -> None:
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        paths = [f"paths.outputs={self.folder / name}", f"paths.cache={cache or self.folder / 'cache'}"]
        job = words if "resume=latest" in words else (*JOB, *words)
        return subprocess.Popen(
            [sys.executable, "-m", "imagination.train", *job, *paths],
            env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
            cwd=self.folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=limited,
        )

    def _finish(self, process: "subprocess.Popen[bytes]", name: str) -> dict[str, bytes | torch.Tensor]:
        """Wait for a run; its tables and weights."""
        told = process.communicate()[1].decode()
        assert process.returncode == 0, told
        run = self.folder / name / "chair_unet" / "latest"
        weights = read_state(run / "checkpoints" / "last.ckpt")["state_dict"]
        return {name: (run / "tables" / name).read_bytes() for name in ("mapping.csv", "ego.csv")} | weights

    def _same(self, process: "subprocess.Popen[bytes]", outputs: Path) -> None:
        """The run ends as the undisturbed one."""
        found = self._finish(process, str(outputs.relative_to(self.folder)))
        for name, value in self.truth.items():
            equal = (
                torch.equal(found[name], value) if isinstance(value, torch.Tensor) else found[name] == value
            )  # type: ignore[arg-type]
            assert equal, f"{outputs}: {name} is not that of an undisturbed run"


def resident() -> float:
    """Memory of this process now, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def main(words: list[str]) -> None:
    """Soak for the minutes asked for and tell what happened."""
    values = {"minutes": 20.0, "seed": 0.0} | {
        key: float(value) for key, _, value in (word.partition("=") for word in words)
    }
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(Path(folder), int(values["seed"]))
        soak.run(values["minutes"])
    first, last = soak.memory[1] if len(soak.memory) > 1 else soak.memory[0], soak.memory[-1]
    count, views = soak.count, 300 * len(soak.memory)
    kills, sizes = len(soak.resumed), ", ".join(map(str, LIMITS))
    table = [
        ("what", "times", "outcome"),
        ("---", "---", "---"),
        (
            "killed at random moments",
            f"{count['killed']} runs, {kills} kills",
            "result of an undisturbed run",
        ),
        (
            f"files limited to {sizes} bytes",
            count["full_disk"],
            "one message, code 2; goes on to that result",
        ),
        ("cache entries damaged under a run", count["damaged"], "made again; that result"),
        ("two runs fill one cache", count["shared"], "that result twice"),
        ("mapping and rendering", f"{views} views", f"{first:.0f} MB at first, {last:.0f} MB at the end"),
    ]
    rows = ["| " + " | ".join(map(str, cells)) + " |" for cells in table]
    told = (
        f"{values['minutes']:g} minutes, seed {values['seed']:g}; a result is tables and weights, to the bit."
    )
    text = "\n".join([told, "", *rows])
    print(text, json.dumps(soak.memory), sep="\n")
    assert last < FLAT * first, f"memory grew from {first:.0f} to {last:.0f} MB"
    write_part("soak", text)


if __name__ == "__main__":
    main(sys.argv[1:])

"""Sweeps on all cores of a machine and on a Ray cluster: the same results, failures told, killed workers replaced."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from imagination import errors
from imagination.errors import UserError
from tests.conftest import ROOT, Command

SWEEP = ["train", "-m", "+experiment=chair_unet", "scale=test", "scale.workers=0", "seed=1,2"]


def tables(outputs: Path) -> dict[str, bytes]:
    """Each member's tables by its folder."""
    found = {}
    for path in sorted(outputs.glob("chair_unet/multirun_*/*/tables/*.csv")):
        found["/".join(path.parts[-3:])] = path.read_bytes()
    return found


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["ray", "joblib"])
def test_the_results_are_the_same_as_without(command: Command, tmp_path: Path, launcher: str) -> None:
    pytest.importorskip(launcher)
    for outputs, choice in (("alone", []), ("spread", [f"hydra/launcher={launcher}"])):
        done = command(*SWEEP, *choice, f"paths.outputs={tmp_path / outputs}", timeout=900)
        assert done.returncode == 0, done.stderr
    alone, spread = tables(tmp_path / "alone"), tables(tmp_path / "spread")
    assert alone == spread and {name.split("/")[0] for name in alone} == {"0", "1"}


@pytest.mark.slow
def test_a_member_that_fails_is_told_and_the_others_finish(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    words = [*SWEEP[:-1], "kernels.imaginable=-1,1.0", "hydra/launcher=ray", "trainer.fast_dev_run=true"]
    done = command(*words, timeout=600)
    assert done.returncode != 0 and "failed" in done.stderr, done.stderr
    assert "kernels.imaginable: got -1" in done.stderr
    assert len(list(tmp_path.glob("outputs/chair_unet/multirun_*/*/config.yaml"))) == 1


@pytest.mark.slow
def test_a_killed_workers_task_is_retried(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    words = [*SWEEP, "hydra/launcher=ray", "scale.rounds=6"]
    with open(tmp_path / "told", "w") as told:
        sweep = subprocess.Popen(
            [sys.executable, "-m", f"imagination.{words[0]}", *words[1:]],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=told,
            stderr=told,
        )
    try:
        while not (victims := workers(sweep.pid)) or not list(
            tmp_path.glob("outputs/chair_unet/*/*/run.log")
        ):
            assert sweep.poll() is None, (tmp_path / "told").read_text()
            time.sleep(0.2)
        os.kill(victims[0], signal.SIGKILL)
        assert sweep.wait(900) == 0, (tmp_path / "told").read_text()
    finally:
        sweep.kill()
    complete = list(tmp_path.glob("outputs/chair_unet/multirun_*/*/tables/mapping.csv"))
    assert len(complete) == 2


def workers(ancestor: int) -> list[int]:
    """Ray's workers that run a member, among the descendants of a process."""
    parents, found = {}, []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if b"ray::run_member" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue

    def descends(pid: int) -> bool:
        return pid == ancestor or (pid in parents and descends(parents[pid]))

    return [pid for pid in found if descends(pid)]


def test_a_missing_extra_names_the_command() -> None:
    from hydra.errors import MissingConfigException

    from imagination.config import explain

    missing = MissingConfigException("Could not find 'hydra/launcher/joblib'", "hydra/launcher/joblib")
    assert "pip install 'imagination[joblib]'" in (explain(missing) or "")


def test_without_ray_the_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "plugins" / "ray"))
    from hydra_plugins.imagination_ray.launcher import RayLauncher

    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'imagination\[ray\]'"):
        RayLauncher(None, 1, 0, 3).launch([["seed=1"]], 0)

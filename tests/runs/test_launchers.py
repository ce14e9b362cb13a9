"""Sweeps on all cores of a machine and on a Ray cluster: same results, failures reported, killed workers replaced."""

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hydra._internal.callbacks import Callbacks
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from imagination.utils import errors
from imagination.utils.errors import UserError
from tests.conftest import ROOT, Command
from tests.helpers.checkpoints import make_checkpoint

SWEEP = ["train", "-m", "+experiment=chair_unet", "scale=test", "data.workers=0", "seed=1,2"]


def tables(outputs: Path) -> dict[str, bytes]:
    """Return the tables of each job by folder."""
    found = {}
    for path in sorted(outputs.glob("*/multirun_*/*/tables/*.csv")):
        found["/".join(path.parts[-3:])] = path.read_bytes()
    return found


def weights(outputs: Path) -> dict[str, dict[str, bytes]]:
    """Return the weights of each job, which show the smallest difference."""
    from imagination.runs.checkpoint import read_state

    found = {
        path.parts[-3]: read_state(path) for path in outputs.glob("*/multirun_*/*/checkpoints/last.ckpt")
    }
    return {
        job: {name: value.numpy().tobytes() for name, value in state["state_dict"].items()}
        for job, state in found.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize(("launcher", "threads"), [("ray", "2"), ("joblib", "1")])
def test_the_results_are_the_same_as_without(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launcher: str, threads: str
) -> None:
    """Compare at the number of threads of a job: hydra.launcher.num_cpus with Ray, one with joblib."""
    pytest.importorskip(launcher)
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    done = command(*SWEEP, f"paths.outputs={tmp_path / 'alone'}", timeout=900)
    assert done.returncode == 0, done.stderr
    monkeypatch.delenv("OMP_NUM_THREADS")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")  # another cluster, which must not be used
    spread = f"hydra/launcher={launcher}", f"paths.outputs={tmp_path / 'spread'}"
    done = command(*SWEEP, *spread, timeout=900)
    assert done.returncode == 0, done.stderr
    assert tables(tmp_path / "alone") == tables(tmp_path / "spread")
    learned = weights(tmp_path / "alone")
    assert learned == weights(tmp_path / "spread") and set(learned) == {"0", "1"}


@pytest.mark.slow
def test_a_cluster_of_two_hosts_runs_the_jobs(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job fills a host, which has one core. The hosts are in a SLURM allocation, where srun started Ray."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    done = command(*SWEEP, f"paths.outputs={tmp_path / 'alone'}", timeout=900)
    assert done.returncode == 0, done.stderr
    for name, number in {"NTASKS": 2, "NTASKS_PER_NODE": 1, "STEP_NUM_TASKS": 2, "PROCID": 1}.items():
        monkeypatch.setenv(f"SLURM_{name}", str(number))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        hosts = [node.all_processes["raylet"][0].process.pid for node in cluster.list_all_nodes()]
        monkeypatch.delenv("SLURM_STEP_NUM_TASKS")  # the sweep is started by the allocation's script
        monkeypatch.setenv("RAY_ADDRESS", cluster.address)
        on_ray = "hydra/launcher=ray", "hydra.launcher.address=auto", "hydra.launcher.num_cpus=1"
        spread = *on_ray, f"paths.outputs={tmp_path / 'spread'}"
        with ThreadPoolExecutor(1) as pool:
            sweep = pool.submit(command, *SWEEP, *spread, timeout=900)
            used = set()
            while not sweep.done():
                used |= {host for host in hosts if workers(host)}
                time.sleep(0.2)
        assert sweep.result().returncode == 0, sweep.result().stderr
    finally:
        cluster.shutdown()
    assert used == set(hosts) and len(used) == 2
    assert tables(tmp_path / "alone") == tables(tmp_path / "spread")
    learned = weights(tmp_path / "alone")
    assert learned == weights(tmp_path / "spread") and set(learned) == {"0", "1"}
    logs = [EventAccumulator(str(path)).Reload() for path in tmp_path.glob("spread/*/*/*/tensorboard")]
    assert [log.Tags()["scalars"].count("test/loss") for log in logs] == [1, 1]
    assert not [host for host in hosts if Path(f"/proc/{host}").exists()]


@pytest.mark.slow
def test_a_failed_job_is_reported_and_the_others_finish(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    words = [*SWEEP[:-1], "kernels.imaginable=-1,1.0", "hydra/launcher=ray", "trainer.fast_dev_run=true"]
    done = command(*words, timeout=600)
    assert done.returncode != 0 and "failed" in done.stderr, done.stderr
    assert "kernels.imaginable: got -1" in done.stderr
    assert len(list(tmp_path.glob("outputs/chair_unet/multirun_*/*/config.yaml"))) == 1


@pytest.mark.slow
def test_a_killed_workers_task_is_retried(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    long = [*SWEEP, "trainer.max_epochs=6"]
    done = command(*long, f"paths.outputs={tmp_path / 'alone'}", timeout=900)
    assert done.returncode == 0, done.stderr
    words = [*long, "hydra/launcher=ray", f"paths.outputs={tmp_path / 'outputs'}"]
    with open(tmp_path / "output", "w") as output:
        sweep = subprocess.Popen(
            [sys.executable, "-m", f"imagination.{words[0]}", *words[1:]],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=output,
            stderr=output,
        )
    try:
        while not (victims := workers(sweep.pid)) or not list(
            tmp_path.glob("outputs/chair_unet/*/*/run.log")
        ):
            assert sweep.poll() is None, (tmp_path / "output").read_text()
            time.sleep(0.2)
        os.kill(victims[0], signal.SIGKILL)
        assert sweep.wait(900) == 0, (tmp_path / "output").read_text()
    finally:
        sweep.kill()
    assert tables(tmp_path / "outputs") == tables(tmp_path / "alone") != {}


@pytest.mark.slow
def test_a_lost_job_stops_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    monkeypatch.syspath_prepend(str(ROOT / "plugins" / "ray"))
    from hydra_plugins.imagination_ray.launcher import RayLauncher

    class Composer:  # a local class is pickled by value for the workers
        def load_sweep_config(self, config: DictConfig, overrides: list[str]) -> DictConfig:
            if overrides == ["killed"]:
                os.kill(os.getpid(), signal.SIGKILL)
            if overrides == ["late"]:
                time.sleep(5)
                (tmp_path / "late").touch()
            raise ValueError(f"no config for {overrides}")

    config = OmegaConf.create({"hydra": {"sweep": {"dir": "the_sweep"}}})
    launcher = RayLauncher("local", num_cpus=0.1, num_gpus=0, max_retries=0)
    context = HydraContext(Composer(), Callbacks())  # type: ignore[arg-type]
    launcher.setup(hydra_context=context, task_function=print, config=config)
    message = r"3 of 3 .*0 \(killed\), 1 \(refused\), 2 \(late\).*hydra\.sweep\.dir=the_sweep"
    with pytest.raises(UserError, match=message):
        launcher.launch([["killed"], ["refused"], ["late"]], 0)
    assert (tmp_path / "late").is_file()


@pytest.mark.slow
def test_parts_of_a_dataset_are_rendered_on_ray(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    words = ["scale=test", "data.splits.train=3", "views=8"]
    spread = ["-m", "parts=2", "part=0,1", "hydra/launcher=ray"]
    for folder, options in (("alone", []), ("spread", spread)):
        done = command("prepare_shards", *options, *words, f"shards={folder}", timeout=600)
        assert done.returncode == 0, done.stderr
    alone, together = (
        {path.name: path.read_bytes() for path in (tmp_path / folder).glob("chunk-*.bin")}
        for folder in ("alone", "spread")
    )
    assert alone == together and len(alone) == 4  # three scenes and the description
    indexes = [json.loads((tmp_path / folder / "index.json").read_text()) for folder in ("alone", "spread")]
    assert indexes[0]["chunks"] == indexes[1]["chunks"]


@pytest.mark.slow
def test_evaluations_on_ray_are_the_same_as_without(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    checkpoint = make_checkpoint(tmp_path / "chair.ckpt", "+experiment=chair_unet")
    words = ["evaluate", "-m", f"ckpt={checkpoint}", "evaluation.cell_widths=[3.0],[2.5]"]
    for outputs, options in (("alone", []), ("spread", ["hydra/launcher=ray"])):
        done = command(*words, *options, f"paths.outputs={tmp_path / outputs}", timeout=600)
        assert done.returncode == 0, done.stderr
    alone, spread = tables(tmp_path / "alone"), tables(tmp_path / "spread")
    assert alone == spread and {"0/tables/mapping.csv", "1/tables/mapping.csv"} <= alone.keys()


def workers(ancestor: int) -> list[int]:
    """Return the Ray workers that run a job, among the descendants of a process."""
    parents, found = {}, []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if b"ray::run_sweep_job" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue

    def descends(pid: int) -> bool:
        return pid == ancestor or (pid in parents and descends(parents[pid]))

    return [pid for pid in found if descends(pid)]


def test_a_missing_extra_names_the_command() -> None:
    from hydra.errors import MissingConfigException

    from imagination.config.user_messages import explain

    missing = MissingConfigException("Could not find 'hydra/launcher/joblib'", "hydra/launcher/joblib")
    assert "pip install -e '.[joblib]'" in (explain(missing) or "")


def test_without_ray_the_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "plugins" / "ray"))
    from hydra_plugins.imagination_ray.launcher import RayLauncher

    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install -e '\.\[ray\]'"):
        RayLauncher("local", 1, 0, 3).launch([["seed=1"]], 0)

"""Sweeps: independent jobs, no job runs twice, and failures are reported at the end."""

import csv
import os
import shlex
import signal
import statistics
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml

from imagination.config.compose import compose
from imagination.config.key_roles import Role
from imagination.config.user_messages import explain
from imagination.runs import sweep_jobs
from imagination.runs.folder import LAST
from imagination.runs.locking import locked
from imagination.runs.sweep_jobs import config_key
from imagination.utils.errors import UserError, install_command
from tests.conftest import ROOT, Command

SWEEPS = sorted(path.stem for path in (ROOT / "conf" / "sweep").glob("*.yaml"))
JOB = ["+experiment=chair_unet", "scale=test"]


def states(sweep: Path) -> list[str]:
    return [job.state for job in sweep_jobs.read(sweep)]


def only(pattern: Path) -> Path:
    (path,) = pattern.parent.glob(pattern.name)
    return path


def test_jobs_are_numbered_in_order_and_found_again(tmp_path: Path) -> None:
    for key in ("a", "b", "a", "c"):
        sweep_jobs.register(tmp_path, key, ["seed=1", "name='x, y'"])
    assert [(job.folder, job.key) for job in sweep_jobs.read(tmp_path)] == [
        ("0", "a"), ("1", "b"), ("2", "c"),
    ]  # fmt: skip
    sweep_jobs.update(tmp_path, "b", state="failed", problem='got 3, "expected" 2')
    assert sweep_jobs.read(tmp_path)[1].problem == 'got 3, "expected" 2'
    assert shlex.split(sweep_jobs.read(tmp_path)[0].overrides) == ["seed=1", "name='x, y'"]
    assert states(tmp_path) == ["missing", "failed", "missing"]


def test_jobs_register_concurrently(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda number: sweep_jobs.register(tmp_path, str(number % 10), []), range(40)))
    assert sorted(int(job.folder) for job in sweep_jobs.read(tmp_path)) == list(range(10))


def test_a_killed_job_counts_as_stopped(tmp_path: Path) -> None:
    job = sweep_jobs.register(tmp_path, "a", [])
    sweep_jobs.update(tmp_path, "a", state="running")
    with locked(tmp_path, sweep_jobs.lock_name(job)):
        assert states(tmp_path) == ["running"]
    assert states(tmp_path) == ["stopped"]


def test_a_folder_without_a_sweep_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="sweep .*jobs.csv"):
        sweep_jobs.read(tmp_path)
    head = ",".join(sweep_jobs.Job._fields)
    for text, message in (
        (b"folder,key\n0,a\n", "folder,key,state"),
        (f"{head}\n0,a,done\n".encode(), "line 2"),
        (f"{head}\n../../x,a,running,,,\n".encode(), "got the folder '../../x'"),
        (b"\xff\xfe", "can't decode"),
    ):
        (tmp_path / sweep_jobs.FILE).write_bytes(text)
        with pytest.raises(UserError, match=rf"jobs.csv: cannot be read .*{message}"):
            sweep_jobs.read(tmp_path)


def test_a_key_depends_on_the_results_only() -> None:
    key = config_key(compose("train", JOB))
    assert key == config_key(compose("train", [*JOB, "paths.outputs=elsewhere"]))
    assert key == config_key(compose("train", [*JOB, "+sweep=dilation"]))
    assert key == config_key(compose("train", [*JOB, "cache.max_gigabytes=5"]))
    for change in ("seed=1", "kernels.imaginable=1.2", "mapping/registration=mean", "trainer.max_epochs=3"):
        assert key != config_key(compose("train", [*JOB, change]))
    trained = config_key(compose("train", JOB), {Role.EVALUATION})
    for change in ("mapping/registration=mean", "evaluation.cell_widths=[1.0]", "evaluation.seed=3"):
        assert trained == config_key(compose("train", [*JOB, change]), {Role.EVALUATION})
    for change in ("seed=1", "kernels.imaginable=1.2", "model=projected"):
        assert trained != config_key(compose("train", [*JOB, change]), {Role.EVALUATION})


def test_a_training_is_identified_by_what_determines_its_result() -> None:
    others = set(Role) - {Role.TRAINING}
    key = config_key(compose("train", JOB), others)
    for change in (
        "logger=csv",
        "logger=null",
        "~callbacks.unit_images",
        "~evaluation.approaches.imagination",
    ):
        assert key == config_key(compose("train", [*JOB, change]), others), change
    for change in ("callbacks.best_checkpoint.mode=min", "trainer.precision=bf16-mixed", "model.width=8"):
        assert key != config_key(compose("train", [*JOB, change]), others), change


def test_a_checkpoint_is_identified_by_its_resolved_path(tmp_path: Path) -> None:
    (tmp_path / "latest").symlink_to("run")
    keys = {config_key(compose("evaluate", [f"ckpt={tmp_path}/{name}/a.ckpt"])) for name in ("latest", "run")}
    assert len(keys) == 1
    assert config_key(compose("evaluate", [f"ckpt={tmp_path}/other/a.ckpt"])) not in keys


@pytest.mark.parametrize("option", ["hydra/launcher/joblib", "hydra/sweeper/optuna"])
def test_a_missing_extra_is_reported_with_its_installation(option: str) -> None:
    from hydra.errors import MissingConfigException

    message = explain(
        MissingConfigException(f"In 'train': Could not find '{option}'\n\nAvailable options: basic")
    )
    assert message is not None and message.endswith(install_command(option.rpartition("/")[2]))


@pytest.mark.slow
def test_a_failed_job_stops_no_other_and_is_retried(command: Command, tmp_path: Path) -> None:
    job = ["-m", *JOB, "name=swept", "trainer.fast_dev_run=true", "callbacks.replay_buffer.prefill_steps=3,8"]
    done = command("train", *job)
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    sweep = only(tmp_path / "outputs" / "swept" / "multirun_*")
    assert states(sweep) == ["failed", "done"]
    assert (sweep / "1" / "tables" / "mapping.csv").is_file()
    assert "1 of 2 " in done.stderr
    failed = [line for line in done.stderr.splitlines() if "0 failed" in line]
    assert len(failed) == 1 and "prefill_steps: got 3" in failed[0]
    assert "callbacks.replay_buffer.prefill_steps=3" in failed[0]
    assert not (tmp_path / "outputs" / "swept" / "latest").exists()
    retry = next(line for line in done.stderr.splitlines() if "imagination.train " in line)
    done = command("train", *shlex.split(retry.partition("imagination.train ")[2]))
    assert done.returncode == 1 and "Job 0:" in done.stderr and "Job 1:" not in done.stderr
    assert [job.folder for job in sweep_jobs.read(sweep)] == ["0", "1"]


@pytest.mark.slow
def test_sweeps_of_evaluation_settings_never_train(command_in_process: Command, tmp_path: Path) -> None:
    for choice in ("+sweep=cell_width", "+sweep=registration"):
        done = command_in_process("train", *JOB, choice)
        assert done.returncode == 2 and "imagination.evaluate -m" in done.stderr, done.stderr
    assert not list(tmp_path.rglob("config.yaml"))


@pytest.mark.parametrize(
    "name", [*SWEEPS[:2], *(pytest.param(name, marks=pytest.mark.slow) for name in SWEEPS[2:])]
)
def test_ready_made_sweeps_compose(name: str) -> None:
    """Every value of every sweep composes, and values of a key differ."""
    hydra = yaml.safe_load((ROOT / "conf" / "sweep" / f"{name}.yaml").read_text())["hydra"]
    assert hydra["mode"] == "MULTIRUN"
    keys = set()
    for key, values in hydra["sweeper"]["params"].items():
        choices = yaml.safe_load(f"[{values}]")
        assert len(choices) > 1
        for value in choices:
            keys.add(config_key(compose("train", [*JOB, f"{key}={value}".replace(" ", "")])))
        assert len(keys) >= len(choices)


def swept(sweep: Path) -> list[dict[str, str]]:
    """Return the overrides of each job by key."""
    lines = [shlex.split(job.overrides) for job in sweep_jobs.read(sweep)]
    return [{key: value for key, _, value in (text.partition("=") for text in line)} for line in lines]


def leaves(node: object, name: str = "") -> dict[str, object]:
    if isinstance(node, dict):
        return {
            path: leaf for key, value in node.items() for path, leaf in leaves(value, f"{name}.{key}").items()
        }
    return {name: node}


@pytest.mark.slow
def test_six_runs_differ_only_in_the_swept_keys(command: Command, tmp_path: Path) -> None:
    """Three values of delta by two of w_alpha max; the HParams tab of TensorBoard shows them with their scores."""
    values = ["kernels.imaginable=0.8,1.0,1.4", "model.loss.alpha_max=10.0,30.0"]
    done = command("train", "-m", *JOB, *values, timeout=1800)
    assert done.returncode == 0, done.stderr
    sweep = only(tmp_path / "outputs" / "chair_unet" / "multirun_*")
    assert states(sweep) == ["done"] * 6
    assert all(0 <= float(job.score) <= 1 for job in sweep_jobs.read(sweep))
    configs = [leaves(yaml.safe_load((sweep / str(n) / "config.yaml").read_text())) for n in range(6)]
    differing = {key for key in configs[0] if len({str(config[key]) for config in configs}) > 1}
    assert {key for key in differing if str(sweep.name) not in str(configs[0][key])} == {
        ".kernels.imaginable", ".data.module.imaginable", ".model.loss.alpha_max", ".model.module.loss.alpha_max",
        ".choices",
    }  # fmt: skip
    pairs = {(config[".kernels.imaginable"], config[".model.loss.alpha_max"]) for config in configs}
    assert pairs == {(delta, alpha) for delta in (0.8, 1.0, 1.4) for alpha in (10.0, 30.0)}
    assert {(line["kernels.imaginable"], line["model.loss.alpha_max"]) for line in swept(sweep)} == {
        (str(delta), str(alpha)) for delta, alpha in pairs
    }
    times = [line for line in done.stderr.splitlines() if line.startswith("Time: ")]
    totals = [float(line.rpartition("total ")[2].split()[0]) for line in times]
    assert len(totals) == 6 and sum(totals) < 1.2 * max(totals) * 6 and totals[5] < 3 * totals[0]
    groups = hparams_of(sweep)
    assert {(g["kernels.imaginable"], g["model.loss.alpha_max"]) for g in groups} == pairs
    assert all("test/iou" in g and "global/chair/imagination/3m" in g for g in groups)


def hparams_of(logdir: Path) -> list[dict[str, float]]:
    """Return the rows of TensorBoard's HParams tab: hyperparameters and scores of each run."""
    from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
    from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
    from tensorboard.context import RequestContext
    from tensorboard.plugins.base_plugin import TBContext
    from tensorboard.plugins.hparams import api_pb2, backend_context, get_experiment, list_session_groups

    multiplexer = EventMultiplexer().AddRunsFromDirectory(str(logdir))
    multiplexer.Reload()
    provider = MultiplexerDataProvider(multiplexer, str(logdir))
    context = backend_context.Context(TBContext(logdir=str(logdir), data_provider=provider))
    request = RequestContext()
    shown = get_experiment.Handler(request, context, "", api_pb2.GetExperimentRequest()).run()
    groups_request = api_pb2.ListSessionGroupsRequest(
        start_index=0,
        slice_size=100,
        allowed_statuses=[api_pb2.STATUS_SUCCESS, api_pb2.STATUS_UNKNOWN],
        col_params=[api_pb2.ColParams(metric=metric.name) for metric in shown.metric_infos],
    )
    response = list_session_groups.Handler(request, context, "", groups_request).run()
    return [
        {name: value.number_value for name, value in group.hparams.items()}
        | {value.name.tag: value.value for value in group.metric_values}
        for group in response.session_groups
    ]


@pytest.mark.slow
def test_a_killed_sweep_continues_with_the_remaining_jobs(command: Command, tmp_path: Path) -> None:
    """SIGKILL in the second job after its first checkpoint: it resumes with the same results as without the kill."""
    job = ["-m", *JOB, "trainer.max_epochs=6", "trainer.check_val_every_n_epoch=2", "seed=1,2,3"]
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert command("train", *job, f"hydra.sweep.dir={whole}", timeout=1200).returncode == 0
    process = subprocess.Popen(
        [sys.executable, "-m", "imagination.train", *job, f"hydra.sweep.dir={broken}"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    while not (broken / "1" / LAST).is_file():
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert states(broken) == ["done", "stopped", "missing"]
    first = (broken / "0" / "tables" / "mapping.csv").stat().st_mtime_ns
    done = command("train", *job, f"hydra.sweep.dir={broken}", timeout=1200)
    assert done.returncode == 0, done.stderr
    assert states(broken) == ["done"] * 3
    assert (broken / "0" / "tables" / "mapping.csv").stat().st_mtime_ns == first
    for number in range(3):
        for table in ("mapping.csv", "mapping_details.csv", "ego.csv"):
            path = Path(str(number)) / "tables" / table
            assert (whole / path).read_bytes() == (broken / path).read_bytes()
    scores = [[job.score for job in sweep_jobs.read(sweep)] for sweep in (whole, broken)]
    assert scores[0] == scores[1]


@pytest.mark.slow
def test_evaluations_are_swept_without_training(command: Command, tmp_path: Path) -> None:
    assert command("train", *JOB, timeout=600).returncode == 0
    checkpoint = tmp_path / "outputs" / "chair_unet" / "latest" / "checkpoints" / "best.ckpt"
    before = checkpoint.stat().st_mtime_ns
    for name, count in (("registration", 5), ("cell_width", 6)):
        done = command(
            "evaluate", f"ckpt={checkpoint}", f"+sweep={name}", f"hydra.sweep.dir={name}", timeout=600
        )
        assert done.returncode == 0, done.stderr
        assert states(tmp_path / name) == ["done"] * count
        saved = yaml.safe_load((tmp_path / name / "0" / "config.yaml").read_text())["ckpt"]
        assert (tmp_path / saved).samefile(checkpoint)
        assert "latest" not in saved  # latest may point to another run later
        assert f"Report: {name}/report.html" in done.stderr
        assert ("est setting" in done.stderr) == (name == "registration")
    assert checkpoint.stat().st_mtime_ns == before and "training epochs" not in done.stderr
    tables = [(tmp_path / "cell_width" / str(n) / "tables" / "mapping.csv").read_text() for n in range(6)]
    widths = [{line.split(",")[2] for line in table.splitlines()[1:]} for table in tables]
    assert [{float(width) for width in some} for some in widths] == [{4.0}, {3.5}, {3.0}, {2.5}, {2.0}, {1.5}]


@pytest.mark.slow
def test_two_settings_with_three_seeds_are_one_table(command: Command, tmp_path: Path) -> None:
    words = [*JOB, "trainer.max_epochs=2", "kernels.imaginable=0.8,1.4", "seed=0,1,2"]
    done = command("train", "-m", *words, "hydra.sweep.dir=swept", timeout=1200)
    assert done.returncode == 0, done.stderr
    assert states(tmp_path / "swept") == ["done"] * 6
    rows = list(csv.DictReader((tmp_path / "swept" / "tables" / "mapping.csv").open()))
    assert [row["kernels.imaginable"] for row in rows][:: len(rows) // 2] == ["0.8", "1.4"]
    assert all(row["seeds"] == "3" and row["iou_seed_std"] for row in rows)
    seeds = list(csv.DictReader((tmp_path / "swept" / "tables" / "mapping_seeds.csv").open()))
    for row in rows:
        place = ("kernels.imaginable", "approach", "category", "cell_width")
        values = [float(each["iou_pooled"]) for each in seeds if all(each[key] == row[key] for key in place)]
        assert len(values) == 3
        assert float(row["iou_pooled"]) == pytest.approx(statistics.mean(values), abs=1e-4)
        assert float(row["iou_seed_std"]) == pytest.approx(statistics.stdev(values), abs=1e-4)
    assert "est setting" in done.stderr  # none if all scores of the short trainings are equal
    assert "Report: swept/report.html" in done.stderr and (tmp_path / "swept" / "report.html").is_file()


@pytest.mark.slow
def test_concurrent_jobs_share_the_cache(command: Command, tmp_path: Path) -> None:
    """Two processes with one empty cache: the same tables as one after the other, and no incomplete files."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    job = ["-m", *JOB, "kernels.imaginable=0.8,1.4"]
    done = command("train", *job, "hydra.sweep.dir=one", "paths.cache=cache_one", timeout=900)
    assert done.returncode == 0, done.stderr
    concurrent = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    done = command("train", *job, *concurrent, "hydra.sweep.dir=two", "paths.cache=cache_two", timeout=900)
    assert done.returncode == 0, done.stderr
    assert states(tmp_path / "two") == ["done"] * 2
    for number in "01":
        tables = [tmp_path / sweep / number / "records" / "trials.csv" for sweep in ("one", "two")]
        assert tables[0].read_bytes() == tables[1].read_bytes()
    entries = [{path.name for path in (tmp_path / f"cache_{sweep}").rglob("*.*")} for sweep in ("one", "two")]
    assert entries[0] == entries[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["encoders", "backbones"])
def test_every_option_of_a_sweep_trains(command: Command, tmp_path: Path, name: str) -> None:
    done = command(
        "train", *JOB, f"+sweep={name}", "trainer.fast_dev_run=true", "hydra.sweep.dir=swept", timeout=1200
    )
    assert done.returncode == 0, done.stderr
    assert set(states(tmp_path / "swept")) == {"done"}


@pytest.mark.slow
def test_a_search_is_continued(command: Command, tmp_path: Path) -> None:
    """Optuna: three trials, then the same search for four; finished trials do not run again."""
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    job = [*JOB, "+hparams_search=optuna", "hydra.sweep.dir=search"]
    done = command("train", *job, "hydra.sweeper.n_trials=3", timeout=1200)
    assert done.returncode == 0, done.stderr
    first = sweep_jobs.read(tmp_path / "search")
    assert [job.state for job in first] == ["done"] * 3
    assert len({line["model.optimizer.lr"] for line in swept(tmp_path / "search")}) == 3
    assert yaml.safe_load((tmp_path / "search" / "optimization_results.yaml").read_text())[
        "best_value"
    ] == max(float(job.score) for job in first)
    done = command("train", *job, "hydra.sweeper.n_trials=4", timeout=1200)
    assert done.returncode == 0, done.stderr
    assert sweep_jobs.read(tmp_path / "search")[:3] == first
    assert states(tmp_path / "search") == ["done"] * 4 and done.stderr.count("Run folder: ") == 1

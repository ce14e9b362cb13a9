"""Fixtures and settings of all tests: checks of array shapes, one thread per process, commands as subprocesses."""

import functools
import importlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # two test processes on two cores

import hydra
import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from jaxtyping import install_import_hook
from omegaconf import DictConfig

from imagination.utils.tabular import PlainLoader
from tests.helpers import shape_checker

ROOT = Path(__file__).resolve().parents[1]


def shaped_modules() -> list[str]:
    """Return the modules whose signatures have array shapes; checking the others would take half of the tests' time."""
    paths = [path for path in (ROOT / "imagination").rglob("*.py") if "jaxtyping import" in path.read_text()]
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]


install_import_hook(shaped_modules(), f"{shape_checker.__name__}.checked")

assert PlainLoader  # defined before the next line, since it extends the parser in Python
yaml.SafeLoader = (
    yaml.CSafeLoader
)  # Hydra parses thousands of files in the tests; libyaml does it in a tenth of the time

_compose = hydra.compose


@functools.lru_cache(maxsize=500)
def _composed(config_name: str, overrides: tuple[str, ...], search_path: str) -> bytes:
    return pickle.dumps(_compose(config_name, list(overrides)))  # bytes cost the garbage collector nothing


def compose_once(config_name: str, overrides: Sequence[str] = (), **options: Any) -> DictConfig:
    """Compose a config, or copy an earlier one: many tests compose the same, for half a second each."""
    loader = GlobalHydra.instance().config_loader()
    search_path = [str(each.path).removeprefix("file://") for each in loader.get_search_path().get_path()]
    changing = any(path.startswith("/") and not Path(path).is_relative_to(ROOT) for path in search_path)
    if changing or options:  # files of a test's own plugin may change
        return _compose(config_name, list(overrides), **options)
    composed: DictConfig = pickle.loads(_composed(config_name, tuple(overrides), "\n".join(search_path)))
    return composed


hydra.compose = compose_once

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def command(tmp_path: Path) -> Command:
    """Run `python -m imagination.<name> <arguments>` in an empty folder."""

    def run(name: str, *arguments: str, timeout: float = 180.0) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        return subprocess.run(
            [sys.executable, "-m", f"imagination.{name}", *arguments],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
        )

    return run


@pytest.fixture
def command_in_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Command:
    """Run a command in this process, which has imported torch already, and in an empty folder.

    For commands that end with a user error; others leave loggers, workers and signal handlers behind.
    """

    def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        module = importlib.import_module(f"imagination.{name}")
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # restores the environment that the command changes
        monkeypatch.setattr("imagination.utils.interrupts.install", lambda: None)
        monkeypatch.setattr(sys, "argv", [f"imagination/{name}.py", *arguments])
        with pytest.raises(SystemExit) as ended:
            module.main()
        assert isinstance(ended.value.code, int)
        return subprocess.CompletedProcess([name, *arguments], ended.value.code, *capfd.readouterr())

    return run


@pytest.fixture
def example_plugin(tmp_path: Path) -> Iterator[Path]:
    """Link the example plugin into plugins/ of the folder in which commands run."""
    folder = tmp_path / "plugins" / "example"
    folder.parent.mkdir()
    folder.symlink_to(ROOT / "tests" / "helpers" / "example_plugin", target_is_directory=True)
    yield folder


EXPORT = """
import sys
from pathlib import Path
from imagination.deployment.export import export
from imagination.runs.checkpoint import Checkpoint
from tests.helpers.checkpoints import make_checkpoint, samples
folder = Path(sys.argv[1])
checkpoint = Checkpoint.read(make_checkpoint(folder / "chair.ckpt", threshold=0.55))
export([checkpoint], folder / "chair.onnx", "onnx", "float32", samples(1))
"""


@pytest.fixture(scope="session")
def unit_file(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """Export a small untrained unit for chairs to ONNX, once for all processes of the tests.

    A process of its own checks no shapes, which would take most of the time.
    """
    from imagination.utils.file_lock import locked_file

    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent
    folder = shared / "unit"
    with locked_file(shared / ".unit.lock"):
        if not (folder / "chair.onnx").is_file():
            folder.mkdir(exist_ok=True)
            environment = os.environ | {"PYTHONPATH": str(ROOT)}
            words = [sys.executable, "-c", EXPORT, str(folder)]
            subprocess.run(words, cwd=ROOT, env=environment, check=True, capture_output=True)
    return folder / "chair.onnx"

"""List of commands, `python -m imagination`, and the console scripts of an installation."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from imagination.__main__ import commands
from imagination.utils.provenance import command_line
from tests.conftest import ROOT

SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        words,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "PATH": f"{folder / 'bin'}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=120,
    )


def install(folder: Path, name: str) -> None:
    """Write a console script as pip does."""
    module, _, function = SCRIPTS[name].partition(":")
    path = folder / "bin" / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(
        f"#!{sys.executable}\nimport sys\nfrom {module} import {function}\nsys.exit({function}())\n"
    )
    path.chmod(0o755)


def test_every_command_is_described(tmp_path: Path) -> None:
    done = run(tmp_path, sys.executable, "-m", "imagination")
    assert done.returncode == 0, done.stderr
    described = dict(line.split(maxsplit=1) for line in done.stdout.splitlines() if line.startswith("  "))
    assert described == commands()
    assert {"train", "report", "prepare_shards", "plugins"} <= set(described)
    for name, text in described.items():
        assert f"python -m imagination.{name}" in text, name
    assert "--help" in done.stdout


@pytest.mark.parametrize(
    ("word", "expected"),
    [("trian", "train"), ("prepare-shards", "prepare_shards"), ("x", "one of: assets, ")],
)
def test_an_unknown_command_is_refused_with_the_closest_name(
    tmp_path: Path, word: str, expected: str
) -> None:
    done = run(tmp_path, sys.executable, "-m", "imagination", word, "scale=test")
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.startswith(f"error: command: got {word!r}, expected {expected}")


def test_a_command_is_run_with_its_arguments(tmp_path: Path) -> None:
    arguments = ["scale=test", "--cfg", "all"]
    done = run(tmp_path, sys.executable, "-m", "imagination", "render", *arguments)
    assert done.returncode == 0, done.stderr
    assert done.stdout == run(tmp_path, sys.executable, "-m", "imagination.render", *arguments).stdout


def test_every_command_has_a_console_script() -> None:
    expected = {f"imagination-{name.replace('_', '-')}": f"imagination.{name}:main" for name in commands()}
    assert expected == SCRIPTS


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        pytest.param("prepare_shards", ["--help"], marks=pytest.mark.slow),
        pytest.param("evaluate", ["seed=3", "--cfg", "all"], marks=pytest.mark.slow),
        pytest.param("report", ["folder=nowhere"], marks=pytest.mark.slow),
        ("plugins", []),
    ],
)
def test_a_console_script_behaves_as_the_module(tmp_path: Path, name: str, arguments: list[str]) -> None:
    script = f"imagination-{name.replace('_', '-')}"
    install(tmp_path, script)
    one = run(tmp_path, script, *arguments)
    other = run(tmp_path, sys.executable, "-m", f"imagination.{name}", *arguments)
    assert one.stdout + one.stderr
    assert (one.returncode, one.stdout, one.stderr) == (other.returncode, other.stdout, other.stderr)


@pytest.mark.parametrize(
    "program", ["/env/bin/imagination-prepare-shards", "/env/lib/imagination/prepare_shards.py"]
)
def test_the_recorded_command_is_that_of_the_module(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    monkeypatch.setattr(sys, "argv", [program, "shards=a b"])
    assert command_line() == "python -m imagination.prepare_shards 'shards=a b'"


COMPLETE = """
eval "$({script} -sc install=bash)"
COMP_LINE={line!r} COMP_POINT=${{#COMP_LINE}} COMP_CWORD={last}
COMP_LINE=$COMP_LINE COMP_POINT=${{#COMP_LINE}} COMP_CWORD={last} hydra_bash_completion
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("imagination-train +experiment=chair_", {"+experiment=chair_best", "+experiment=chair_unet"}),
        ("imagination-train scale=test data/scenes=b", {"data/scenes=box_rooms"}),
        pytest.param("imagination-report fol", {"folder="}, marks=pytest.mark.slow),
        pytest.param("imagination-report folder=./ru", {"folder=./run"}, marks=pytest.mark.slow),
    ],
)
def test_bash_completes_groups_options_and_keys(
    tmp_path: Path, example_plugin: Path, line: str, expected: set[str]
) -> None:
    """The broken plugin writes nothing between the prompt and the word."""
    (tmp_path / "run").mkdir()
    (tmp_path / "plugins" / "broken").mkdir()
    script, *words = line.split()
    install(tmp_path, script)
    code = COMPLETE.format(script=script, line=line, last=len(words))
    done = run(tmp_path, "bash", "--norc", "-c", code)
    assert (set(done.stdout.split()), done.stderr) == (expected, "")

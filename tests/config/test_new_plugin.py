"""New plugins: what is written, names that are refused, and failures that leave nothing behind."""

import errno
import importlib
import keyword
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from imagination.config.compose import compose
from imagination.config.contracts import check_contracts, check_plugin
from imagination.config.new_plugin import (
    MAX_LENGTH,
    NEXT_STEPS,
    check_plugin_name,
    rendered,
    similar_name,
    write_plugin,
)
from imagination.config.plugin_registry import discover
from imagination.config.validation import validate
from imagination.utils.errors import CannotWriteError, UserError
from tests.conftest import ROOT, Command
from tests.helpers.plugin_modules import new_process
from tests.test_imports import private_imports

NAME = "my_plugin"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Current directory, which is empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_new_plugin_is_complete_and_passes_the_check(folder: Path) -> None:
    files = write_plugin(NAME)
    root = folder / "plugins" / NAME
    assert {folder / file for file in files} == {path for path in root.rglob("*") if path.is_file()}
    assert [path.name for path in (folder / "plugins").iterdir()] == [NAME]
    assert {"README.md", "pyproject.toml", f"tests/test_{NAME}.py"} <= {
        path.relative_to(f"plugins/{NAME}").as_posix() for path in files
    }
    for file in files:
        text = file.read_text()
        assert "{{" not in text and "NAME" not in str(file)
        assert not file.name.endswith(".py") or not private_imports(text), file
    with new_process(root):
        (plugin,) = [plugin for plugin in discover() if plugin.name == NAME]
        assert (plugin.problem, check_plugin(plugin)) == ("", "")
        assert plugin.options == [
            f"experiment/{NAME}_chair",
            f"mapping/registration/{NAME}_average",
            f"model/loss/{NAME}_bce",
        ]


def test_its_experiment_composes(folder: Path) -> None:
    write_plugin(NAME)
    with new_process(folder / "plugins" / NAME):
        config = compose("train", [f"experiment={NAME}_chair", "scale=test", "paths.run=."])
        validate(config)
        check_contracts(config)
    assert config.model.loss._target_ == f"imagination_{NAME}.losses.ConstantWeightBCE"
    assert config.mapping.registration._target_ == f"imagination_{NAME}.rules.AsymmetricAverage"


def test_its_own_tests_pass(folder: Path) -> None:
    """In this process; the slow test runs pytest."""
    write_plugin(NAME)
    root = folder / "plugins" / NAME
    with new_process(root), pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(root / "tests")
        module = importlib.import_module(f"test_{NAME}")
        tests = [value for name, value in vars(module).items() if name.startswith("test_")]
        assert len(tests) == 5
        for test in tests:
            test()


def test_its_code_is_formatted_and_linted(folder: Path) -> None:
    files = write_plugin(NAME)
    package = [str(file) for file in files if file.parent.name == f"imagination_{NAME}"]
    ours = [
        "--config",
        str(ROOT / "pyproject.toml"),
        "--ignore",
        "I001",
    ]  # the plugin sorts imports as it likes
    for arguments in (["check", "."], ["format", "--check", "."], ["check", *ours, *package]):
        done = subprocess.run([sys.executable, "-m", "ruff", *arguments], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


def test_its_entry_point_and_wheel_have_the_conf_tree() -> None:
    project = tomllib.loads(rendered(NAME)["pyproject.toml"])
    assert project["project"]["entry-points"]["imagination.plugins"] == {NAME: f"imagination_{NAME}.conf"}
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["force-include"] == {"conf": f"imagination_{NAME}/conf"}
    assert project["project"]["name"] == "imagination-my-plugin"


@pytest.mark.parametrize("name", ["mine", "a", "x1", "box_rooms_2", "match", "a" * MAX_LENGTH])
def test_a_valid_name_is_accepted(name: str) -> None:
    assert check_plugin_name(name) == similar_name(name) == name


@pytest.mark.parametrize(
    ("name", "similar"),
    [
        ("My-Plugin", "my_plugin"),
        ("BoxRooms", "box_rooms"),
        ("RGBNoise", "rgb_noise"),
        ("my plugin", "my_plugin"),
        ("3rooms", "rooms"),
        ("_hidden", "hidden"),
        ("two__words", "two_words"),
        ("class", "class_plugin"),
        ("möbel", "mobel"),
        ("../mine", "mine"),
        ("a/b", "a_b"),
        ("mine\n", "mine"),
        ("", "my_plugin"),
        ("…", "my_plugin"),
        ("a" * (MAX_LENGTH + 1), "a" * MAX_LENGTH),
        (3, "my_plugin"),
        (True, "true_plugin"),
        ("inf", "inf_plugin"),
    ],
)
def test_an_invalid_name_is_refused_with_a_similar_one(folder: Path, name: object, similar: str) -> None:
    with pytest.raises(UserError) as error:
        write_plugin(name)
    message = str(error.value)
    assert message.startswith(f"new: got {name!r}, expected ") and message.endswith(f"; try new={similar}")
    assert list(folder.iterdir()) == []


@given(st.text(st.sampled_from("abzAZ019_- .é"), max_size=60) | st.text(max_size=60))
@example("a" * 39 + "_b")
@example("\ud800")
def test_a_similar_name_is_valid(text: str) -> None:
    name = similar_name(text)
    assert re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) and len(name) <= MAX_LENGTH
    assert name.isidentifier() and not keyword.iskeyword(name)
    assert check_plugin_name(name) == name


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_an_existing_path_is_refused_and_stays(folder: Path, kind: str) -> None:
    path = folder / "plugins" / NAME
    path.parent.mkdir()
    if kind == "folder":
        path.mkdir()
        (path / "mine.txt").write_text("mine")
    elif kind == "file":
        path.write_text("mine")
    else:
        path.symlink_to("nowhere")
    with pytest.raises(
        UserError, match=rf"new: got '{NAME}', but plugins/{NAME} exists, expected .*new folder"
    ):
        write_plugin(NAME)
    assert [each.name for each in path.parent.iterdir()] == [NAME]
    assert kind != "folder" or (path / "mine.txt").read_text() == "mine"


def test_the_name_of_another_plugin_is_refused(folder: Path) -> None:
    with pytest.raises(UserError, match="new: got 'ros', the name of the plugin in folder .*plugins/ros"):
        write_plugin("ros")


def test_the_name_of_an_option_is_refused(folder: Path) -> None:
    conf = folder / "plugins" / "other" / "conf" / "model" / "loss"
    conf.mkdir(parents=True)
    (conf / f"{NAME}_bce.yaml").write_text("a: 1")
    with pytest.raises(
        UserError,
        match=rf"new: got '{NAME}', whose option 'model/loss/{NAME}_bce' exists .*folder .*plugins/other",
    ):
        write_plugin(NAME)
    assert [path.name for path in (folder / "plugins").iterdir()] == ["other"]


def test_the_name_of_an_installed_package_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "site" / f"imagination_{NAME}").mkdir(parents=True)
    (folder / "site" / f"imagination_{NAME}" / "__init__.py").touch()
    monkeypatch.syspath_prepend(folder / "site")
    with pytest.raises(
        UserError, match=f"new: got '{NAME}', but the package imagination_{NAME} is installed"
    ):
        write_plugin(NAME)


@pytest.mark.parametrize("written", [0, 1, 5])
def test_a_full_disk_leaves_no_part_of_a_plugin(
    folder: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    write_text, calls = Path.write_text, []

    def write(path: Path, text: str) -> int:
        calls.append(path)
        if len(calls) > written:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write_text(path, text)

    monkeypatch.setattr(Path, "write_text", write)
    with pytest.raises(
        CannotWriteError, match=f"new: could not write plugins/{NAME}: No space left on device; "
    ):
        write_plugin(NAME)
    assert list((folder / "plugins").iterdir()) == []


def test_a_folder_that_cannot_be_written_is_reported(folder: Path) -> None:
    (folder / "plugins").write_text("a file")
    with pytest.raises(
        CannotWriteError, match=f"new: could not write plugins/{NAME}: .*in which you may write"
    ):
        write_plugin(NAME)
    assert (folder / "plugins").read_text() == "a file"


def test_a_plugin_that_another_process_writes_at_the_same_time_stays(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("imagination.config.new_plugin._check_unused", lambda *arguments: None)
    other = folder / "plugins" / NAME / "other.txt"
    other.parent.mkdir(parents=True)
    other.write_text("other")
    with pytest.raises(CannotWriteError, match=f"new: could not write plugins/{NAME}"):
        write_plugin(NAME)
    assert [path.name for path in (folder / "plugins").iterdir()] == [NAME]
    assert [path.name for path in other.parent.iterdir()] == ["other.txt"]


def run(folder: Path, command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command that the program prints."""
    words = [sys.executable, *command.split()[1:]]
    variables = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run(words, cwd=folder, env=variables, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_the_next_commands_succeed(folder: Path) -> None:
    """Those that are printed after a plugin is written: the check, its tests, and a training."""
    write_plugin(NAME)
    commands = [line.strip() for line in NEXT_STEPS.format(name=NAME).splitlines() if line.startswith("    ")]
    assert [command.split()[2] for command in commands] == [
        "imagination.plugins",
        "pytest",
        "imagination.train",
    ]
    for command in commands[1:]:
        done = run(folder, command)
        assert done.returncode == 0, done.stdout + done.stderr
    assert f"{NAME}  (folder {folder}/plugins/{NAME})\n    adds " in run(folder, commands[0]).stdout
    final = folder / "outputs" / f"{NAME}_chair" / "latest" / "final.json"
    assert final.is_file()


@pytest.mark.slow
def test_an_installed_plugin_is_found(folder: Path) -> None:
    write_plugin(NAME)
    done = run(folder / "plugins" / NAME, "python -m hatchling build -t wheel")
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = (folder / "plugins" / NAME / "dist").glob("*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    (folder / "elsewhere").mkdir()
    done = run(folder / "elsewhere", "python -m imagination.plugins", PYTHONPATH=f"{folder}/site:{ROOT}")
    assert done.returncode == 0, done.stderr
    assert (
        f"{NAME}  (distribution imagination-my-plugin 0.1.0)\n    adds experiment/{NAME}_chair, "
        in done.stdout
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["new=My-Plugin"], "error: new: got 'My-Plugin', expected "),
        (["new=true"], "error: new: got True, expected "),
        (["new=[a,b]"], "error: new: got ['a', 'b'], expected "),
        (["new=mine", "check=true"], "error: check: got true with new="),
    ],
)
def test_user_errors_get_one_message(
    command_in_process: Command, tmp_path: Path, arguments: list[str], message: str
) -> None:
    done = command_in_process("plugins", *arguments)
    assert done.returncode == 2 and done.stderr.startswith(message)
    assert done.stderr.count("\n") == 1 and list(tmp_path.iterdir()) == []

"""Command that lists and checks the plugins."""

from pathlib import Path

import pytest

from tests.conftest import Command


@pytest.fixture
def broken_plugin(tmp_path: Path) -> None:
    """Plugin whose code cannot be imported."""
    conf = tmp_path / "plugins" / "broken" / "conf" / "model"
    conf.mkdir(parents=True)
    (conf / "mine.yaml").write_text("_target_: no_such_package.Class")


def test_plugins_are_listed_with_their_options(
    command: Command, example_plugin: Path, broken_plugin: None, tmp_path: Path
) -> None:
    done = command("plugins")
    assert done.returncode == 0, done.stderr
    assert (
        "adds callbacks/counting, data/scenes/box_rooms, experiment/blind_seats, model/blind" in done.stdout
    )
    assert "no_such_package" not in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"plugins"}


def test_their_code_is_checked_on_request(command: Command, broken_plugin: None) -> None:
    done = command("plugins", "check=true")
    assert done.returncode == 1 and "no_such_package" in done.stdout


def test_a_new_plugin_is_written(command: Command, tmp_path: Path) -> None:
    done = command("plugins", "new=mine")
    assert done.returncode == 0, done.stderr
    written = [line for line in done.stdout.splitlines() if line.startswith("plugins/mine/")]
    assert "plugins/mine/imagination_mine/losses.py" in written
    assert all((tmp_path / line.split()[0]).is_file() for line in written)
    assert "python -m imagination.plugins check=true" in done.stdout
    assert "mine  (folder" in command("plugins").stdout
    again = command("plugins", "new=mine")
    assert again.returncode == 2 and "new: got 'mine'" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["deep=true"], "deep"), (["check=maybe"], "check: got 'maybe'"), (["-m"], "-m: ")],
)
def test_user_errors_get_one_message(command: Command, arguments: list[str], message: str) -> None:
    done = command("plugins", *arguments)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and message in done.stderr

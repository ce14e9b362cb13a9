"""Command that downloads and lists the assets of plugins."""

import os
import stat
from pathlib import Path

import pytest

from imagination.config.plugin_registry import activate
from imagination.utils.errors import UserError
from tests.conftest import Command
from tests.helpers.sweet_home import write_catalogue, write_home

activate()

from imagination_sweethome3d.assets import FurniturePackage, examine  # noqa: E402 isort: skip


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        ([], ["name: got none", "sweethome3d", "imagination.assets name=sweethome3d"]),
        (["name=attic"], ["name: got 'attic'", "sweethome3d"]),
        (["name=sweethome3d", "deep=true"], ["deep"]),
        (["sweethome3d", "list=true"], ["imagination.assets name=sweethome3d list=true"]),
    ],
)
def test_user_errors_get_one_message(command: Command, arguments: list[str], messages: list[str]) -> None:
    done = command("assets", *arguments)
    assert done.returncode == 2 and done.stderr.startswith("error: "), done.stderr
    assert "Traceback" not in done.stderr and all(text in done.stderr for text in messages), done.stderr


def tool(folder: Path, name: str, script: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)


@pytest.mark.slow
def test_the_furniture_is_downloaded_without_root_and_listed(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = write_catalogue(tmp_path / "made" / "Test.sh3f")
    tools = tmp_path / "bin"
    tools.mkdir()
    tool(tools, "apt-get", "touch sweethome3d-furniture_1.8-1_all.deb")
    tool(
        tools,
        "dpkg",
        f'mkdir -p "$3/usr/share/sweethome3d/furniture" && cp {made} "$3/usr/share/sweethome3d/furniture/"',
    )
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    monkeypatch.setenv("IMAGINATION_ASSETS", str(tmp_path / "assets"))
    done = command("assets", "name=sweethome3d")
    assert "1 furniture archives of Sweet Home 3D with 12 pieces" in done.stdout, done.stderr
    assert list((tmp_path / "assets").rglob("Test.sh3f"))
    lines = command("assets", "name=sweethome3d", "list=true").stdout.splitlines()
    assert any(
        line.startswith("chair") and "Test#chair1 (Chair; Somebody, CC BY 3.0)" in line for line in lines
    )
    assert lines[-1] == "12 models in use, 0 left out"
    write_home(tmp_path / "scenes" / "flat.sh3d")
    lines = command("assets", "name=sweethome3d", "list=scenes").stdout.splitlines()
    assert {path.name for path in tmp_path.iterdir()} == {"made", "bin", "assets", "scenes"}
    assert lines[:2] == ["flat (train)", "    Sedia: chair (by catalogue), drawn as its model"]


def test_a_failed_download_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tool(tmp_path, "apt-get", "echo 'E: no network' >&2; exit 100")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("IMAGINATION_ASSETS", str(tmp_path / "none"))
    with pytest.raises(UserError, match="apt-get download failed: E: no network; install Debian's package"):
        FurniturePackage().fetch()


def test_a_file_that_is_no_archive_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMAGINATION_ASSETS", str(tmp_path))
    (tmp_path / "fake.sh3f").write_text("no zip")
    with pytest.raises(UserError, match="fake.sh3f: is not a zip file"):
        FurniturePackage().fetch()
    (finding,) = examine()
    assert finding.good is False and "fake.sh3f: is not a zip file" in finding.message

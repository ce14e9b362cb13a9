"""Commands that download the assets of plugins and check the machine."""

import os
import stat
from pathlib import Path

import pytest

from imagination import assets
from imagination.config.plugin_registry import activate
from imagination.utils.errors import UserError
from tests.conftest import Command
from tests.helpers.sweet_home import write_catalogue, write_home

activate()

from imagination_sweethome3d.assets import examine  # noqa: E402 isort: skip


def test_assets_lists_the_names(capsys: pytest.CaptureFixture[str]) -> None:
    assets.main([])
    assert "sweethome3d" in capsys.readouterr().out
    with pytest.raises(UserError, match="assets: got 'attic', .*sweethome3d"):
        assets.main(["attic"])
    with pytest.raises(UserError, match="assets: got deep=true, .*list=true"):
        assets.main(["sweethome3d", "deep=true"])


def tool(folder: Path, name: str, script: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)


def test_the_furniture_is_downloaded_without_root_and_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
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
    assets.main(["sweethome3d"])
    assert "1 furniture archives of Sweet Home 3D with 12 pieces" in capsys.readouterr().out
    assert list((tmp_path / "assets").rglob("Test.sh3f"))
    assets.main(["sweethome3d", "list=true"])
    lines = capsys.readouterr().out.splitlines()
    assert any(
        line.startswith("chair") and "Test#chair1 (Chair; Somebody, CC BY 3.0)" in line for line in lines
    )
    assert lines[-1] == "12 models in use, 0 left out"
    write_home(tmp_path / "scenes" / "flat.sh3d")
    assets.main(["sweethome3d", f"list={tmp_path / 'scenes'}"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["flat (train)", "    Sedia: chair (by catalogue), drawn as its model"]


def test_a_failed_download_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tool(tmp_path, "apt-get", "echo 'E: no network' >&2; exit 100")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("IMAGINATION_ASSETS", str(tmp_path / "none"))
    with pytest.raises(UserError, match="apt-get download failed: E: no network; install Debian's package"):
        assets.main(["sweethome3d"])


def test_a_file_that_is_no_archive_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMAGINATION_ASSETS", str(tmp_path))
    (tmp_path / "fake.sh3f").write_text("no zip")
    with pytest.raises(UserError, match="fake.sh3f: is not a zip file"):
        assets.main(["sweethome3d"])
    (finding,) = examine()
    assert finding.good is False and "fake.sh3f: is not a zip file" in finding.message


def test_the_doctor_reports_on_the_machine_and_the_plugins(command: Command) -> None:
    done = command("doctor")
    lines = {line[4:].split("  ")[0].strip(): line for line in done.stdout.splitlines()}
    assert {"python", "torch", "memory", "plugin sweethome3d", "habitat-sim", "furniture"} <= set(lines)
    assert lines["python"].startswith("ok")
    assert "habitat" in lines["habitat-sim"] and done.returncode in (0, 1)

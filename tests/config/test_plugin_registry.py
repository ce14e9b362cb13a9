"""Discovery of plugins; invalid plugins are ignored with a reason and do not stop other commands."""

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from imagination.config.contracts import check_plugin
from imagination.config.plugin_registry import Plugin, discover, provided
from imagination.utils.code_hash import GROUP
from tests.conftest import Command


def make(folder: Path, **files: str) -> Path:
    """Write a plugin folder; in the names of files, __ stands for a slash, and YAML files have no suffix."""
    for name, text in files.items():
        path = folder / name.replace("__", "/")
        path = path if path.suffix else path.with_suffix(".yaml")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Plugin]:
    monkeypatch.chdir(tmp_path)
    return {plugin.name: plugin for plugin in discover()}


def test_a_folder_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(tmp_path / "plugins" / "rooms", **{"conf__data__scenes__mine": "a: 1", "pack__x": ""})
    (tmp_path / "plugins" / "rooms" / "pack" / "__init__.py").touch()
    plugin = found(tmp_path, monkeypatch)["rooms"]
    assert (plugin.problem, plugin.options, plugin.packages) == ("", ["data/scenes/mine"], ["pack"])


@pytest.mark.parametrize(
    ("files", "problem"),
    [
        ({"readme": "x"}, "no config found in"),
        ({"conf__model__mine": "a: [1"}, r"model/mine.yaml cannot be read"),
        ({"conf__model__mine": "a: 2026-13-45"}, r"model/mine.yaml cannot be read"),
        ({"conf__model__mine": "a: !!bool x"}, r"model/mine.yaml cannot be read"),
        ({"conf__scale__small": "a: 1"}, "'scale/small' exists already in the core"),
    ],
)
def test_a_broken_folder_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: dict[str, str], problem: str
) -> None:
    make(tmp_path / "plugins" / "broken", **files)
    make(tmp_path / "plugins" / "valid", conf__model__other="a: 1")
    plugins = found(tmp_path, monkeypatch)
    assert problem in plugins["broken"].problem
    assert plugins["valid"].problem == ""


def test_a_config_without_a_target_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    make(tmp_path / "plugins" / "mine", conf__assets__mine="a: 1")
    monkeypatch.chdir(tmp_path)
    assert "mine" not in {name for name, _, _ in provided("assets")}
    assert "assets/mine.yaml: got no _target_" in caplog.text


def test_two_plugins_may_not_add_the_same_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("first", "second"):
        make(tmp_path / "plugins" / name, conf__model__mine="a: 1")
    plugins = found(tmp_path, monkeypatch)
    assert plugins["first"].problem == ""
    assert "'model/mine' exists already in folder" in plugins["second"].problem


class Distribution:
    name, version = "rooms-package", "1.2"


def install(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    point = EntryPoint("rooms", value, GROUP)
    vars(point)["dist"] = Distribution()
    monkeypatch.setattr(
        "imagination.config.plugin_registry.entry_points", lambda group: [point] if group == GROUP else []
    )


def test_an_installed_distribution_is_found_without_importing_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path / "site" / "rooms_package", conf__model__mine="a: 1")
    (tmp_path / "site" / "rooms_package" / "__init__.py").write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    install(monkeypatch, "rooms_package.conf")
    plugin = found(tmp_path, monkeypatch)["rooms"]
    assert (plugin.origin, plugin.problem) == ("distribution rooms-package 1.2", "")
    assert plugin.options == ["model/mine"]
    assert "RuntimeError: imported" in check_plugin(plugin)


@pytest.mark.parametrize(
    ("value", "problem"),
    [("no_such_package.conf", "no package 'no_such_package'"), ("hydra.nothing", "no config found")],
)
def test_a_broken_distribution_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str, problem: str
) -> None:
    install(monkeypatch, value)
    assert problem in found(tmp_path, monkeypatch)["rooms"].problem


def test_a_broken_plugin_fails_only_if_it_is_used(command: Command, tmp_path: Path) -> None:
    make(
        tmp_path / "plugins" / "broken",
        conf__model__mine="_target_: no_such_package.Class",
        conf__scale__small="a: 1",
    )
    done = command("train", "+experiment=chair_unet", "scale=test", "--cfg", "job")
    assert done.returncode == 0
    assert "broken (folder" in done.stderr and "'scale/small' exists already" in done.stderr
    done = command("train", "model=mine", "--cfg", "job")
    assert done.returncode == 2
    assert "broken (folder" in done.stderr and "model: got 'mine'" in done.stderr


@pytest.mark.slow
def test_the_example_adds_scenes_a_unit_and_a_callback(
    command: Command, example_plugin: Path, tmp_path: Path
) -> None:
    done = command("train", "+experiment=blind_seats", "scale=test")
    assert done.returncode == 0, done.stderr
    run = tmp_path / "outputs" / "blind_seats" / "latest"
    assert (run / "epochs.txt").read_text() == "2"
    assert "chair" in (run / "tables" / "mapping.csv").read_text()

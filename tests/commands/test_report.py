"""Command that writes a report on a results folder."""

import sys
from pathlib import Path

import pytest

from imagination import report
from imagination.utils import interrupts
from tests.conftest import Command
from tests.helpers.run_folders import make_folder


@pytest.mark.slow
def test_a_page_in_the_folder_or_for_the_documentation(command: Command, tmp_path: Path) -> None:
    make_folder(tmp_path / "run")
    done = command("report", "folder=run", "docs=pages/study")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "pages" / "study.md").is_file() and list((tmp_path / "pages" / "study").glob("*.png"))
    assert not (tmp_path / "run" / "report.html").exists()
    done = command("report", "folder=run")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "report.html").is_file()
    assert {path.name for path in tmp_path.iterdir()} == {"run", "pages"}


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        (["folder=outputs/run"], (Path("outputs/run"), None, None)),
        (["folder=run", "docs=docs/study"], (Path("run"), Path("docs/study"), None)),
        (["folder=run", "output=mine"], (Path("run"), None, Path("mine"))),
        (["folder='my run,2'"], (Path("my run,2"), None, None)),
    ],
)
def test_overrides_choose_the_folder_and_the_page(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    written: tuple[Path, Path | None, Path | None],
) -> None:
    """The files of a report are tested in tests/reporting."""
    calls = []
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(interrupts, "install", lambda: None)  # in the process of the tests
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["report", *arguments])
    monkeypatch.setattr(report, "write", lambda *paths: calls.append(paths))
    report.main()
    assert calls == [written]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "folder: got none, expected"),
        (["folder=nowhere"], "folder: got nowhere"),
        (["folder=a", "output=b", "docs=c"], "output: got b and docs=c"),
        (["folder=a", "docs="], "docs: got ''"),
        (["folder=a", "docs=.."], "docs: got '..'"),
        (["folder=a", "output=''"], "output: got ''"),
        (["folder=a", f"output={'x' * 300}"], "output: got xxx"),
        ([f"folder={'x' * 300}"], "folder: got xxx"),
        (["nowhere", "--docs", "page"], "imagination.report folder=nowhere docs=page"),
        (["folder=a", "--docs"], "--docs"),
    ],
)
def test_user_errors_get_one_message(command_in_process: Command, arguments: list[str], message: str) -> None:
    done = command_in_process("report", *arguments)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert message in done.stderr

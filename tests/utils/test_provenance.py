"""Provenance of results."""

import subprocess
from datetime import datetime
from pathlib import Path

import pytest

from imagination.utils import provenance


def git(folder: Path, *words: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    command = ["git", "-C", str(folder), *identity, *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


commit_of = provenance.git_commit.__wrapped__  # reads it again


def test_the_commit_is_marked_if_files_were_changed(tmp_path: Path) -> None:
    git(tmp_path, "init", "-q")
    (tmp_path / "file").write_text("1")
    git(tmp_path, "add", "file")
    git(tmp_path, "commit", "-qm", "first")
    git(tmp_path, "tag", "v1")
    commit = git(tmp_path, "rev-parse", "HEAD")
    assert commit_of(tmp_path) == commit
    (tmp_path / "file").write_text("2")
    assert commit_of(tmp_path) == f"{commit}-dirty"


def test_there_is_no_commit_outside_a_checkout_or_without_git(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    git(tmp_path, "init", "-q")
    (tmp_path / "installed").mkdir()
    assert commit_of(tmp_path / "installed") == ""  # the checkout of another project
    monkeypatch.setenv("PATH", "")
    assert commit_of(tmp_path) == ""


def test_the_provenance_of_this_process() -> None:
    found = provenance.current_provenance()
    assert datetime.fromisoformat(found.date).tzinfo is not None
    assert "cores" in found.processor and found.command.startswith("python ")

"""Command that checks the machine and the plugins."""

from pathlib import Path

import pytest

from tests.conftest import Command


def test_the_doctor_reports_on_the_machine_and_the_plugins(command: Command, tmp_path: Path) -> None:
    done = command("doctor")
    lines = {line[4:].split("  ")[0].strip(): line for line in done.stdout.splitlines()}
    assert {"python", "torch", "memory", "plugin sweethome3d", "habitat-sim", "furniture"} <= set(lines)
    assert lines["python"].startswith("ok")
    assert "habitat" in lines["habitat-sim"]
    assert done.returncode == any(line.startswith("!!") for line in lines.values())
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_check_that_fails_is_a_finding(command: Command, tmp_path: Path) -> None:
    conf = tmp_path / "plugins" / "broken" / "conf" / "doctor"
    conf.mkdir(parents=True)
    (conf / "broken.yaml").write_text("_target_: os.no_such_function")
    done = command("doctor")
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "!!  plugin broken" in done.stdout and "os.no_such_function" in done.stdout


def test_unknown_arguments_are_refused(command: Command) -> None:
    done = command("doctor", "deep=true")
    assert done.returncode == 2 and done.stderr.startswith("error: ") and "deep" in done.stderr

"""Errors of the command that maps live images; tests/plugins/ros maps with a server."""

import pytest

from imagination.serve import check_server
from imagination.utils.errors import UserError
from tests.conftest import Command


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "unit: got none"),
        (["server=nothing", "unit=a.onnx"], "server: got 'nothing', expected one of: rclpy"),
        (["unit=a.onnx", "threshold=2"], "threshold: got 2"),
        (["unit=a.onnx,b.onnx", "-m"], "-m: imagination.serve "),
    ],
)
def test_user_errors_get_one_message(command_in_process: Command, arguments: list[str], message: str) -> None:
    done = command_in_process("serve", *arguments)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.startswith("error: ") and message in done.stderr


def test_without_a_plugin_with_a_server_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imagination.serve.activate", list)
    with pytest.raises(UserError, match="server: got 'zenoh'.*plugins/ros"):
        check_server("zenoh")

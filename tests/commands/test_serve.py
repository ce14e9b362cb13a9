"""Errors of the command that maps live images; tests/plugins/ros maps with a server."""

import pytest
from omegaconf import OmegaConf

from imagination.serve import validate
from imagination.utils.errors import UserError
from tests.conftest import Command


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "unit: got none"),
        (["server=nothing", "unit=a.onnx"], "rclpy"),
        (["unit=a.onnx", "threshold=2"], "threshold: got 2"),
        (["unit=a.onnx,b.onnx", "-m"], "-m: imagination.serve "),
    ],
)
def test_user_errors_get_one_message(command: Command, arguments: list[str], message: str) -> None:
    done = command("serve", *arguments)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.startswith("error: ") and message in done.stderr


def test_without_a_plugin_with_a_server_the_remedy_is_named() -> None:
    with pytest.raises(UserError, match="server: got none.*plugins/ros"):
        validate(OmegaConf.create({"name": "serve", "unit": "a.onnx"}))

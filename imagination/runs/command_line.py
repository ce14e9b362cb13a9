"""Command lines that are shown to the user, quoted so that they can be pasted into a shell."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from imagination.config.overrides import override_key
from imagination.runs.folder import resolved_path


def command_line(name: str, arguments: Sequence[str]) -> str:
    """Return the command line of a command of the project."""
    return shlex.join(["python", "-m", f"imagination.{name}", *arguments])


def own_arguments(without: Sequence[str] = ()) -> list[str]:
    """Return the arguments of this process, with the same meaning later.

    A `ckpt` argument has no symlinks, because `latest` may point to another run later.

    Args:
        without: keys of overrides to leave out.
    """
    return [_permanent(text) for text in sys.argv[1:] if override_key(text) not in without]


def _permanent(text: str) -> str:
    path = Path(text.removeprefix("ckpt="))
    return f"ckpt={resolved_path(path)}" if text.startswith("ckpt=") and path.is_file() else text

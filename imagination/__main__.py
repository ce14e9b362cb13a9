"""List the commands, or run one: `python -m imagination train …` is `python -m imagination.train …`."""

import ast
import difflib
import runpy
import sys
from collections.abc import Mapping
from pathlib import Path

HELP = """Commands: python -m imagination.NAME [key=value …], or imagination-NAME (with - instead of _).

{commands}

Keys and options of a command: python -m imagination.NAME --help"""
"""Text of the list of commands."""


def commands() -> dict[str, str]:
    """Return the first line of the docstring of each command, by name; no command is imported."""
    files = sorted(Path(__file__).parent.glob("[!_]*.py"))
    docstrings = {path.stem: ast.get_docstring(ast.parse(path.read_bytes())) for path in files}
    return {name: (text or "").partition("\n")[0] for name, text in docstrings.items()}


def unknown(name: str, known: Mapping[str, str]) -> str:
    """Return the message for a name that is not a command."""
    close = difflib.get_close_matches(name, known, 1)
    expected = close[0] if close else f"one of: {', '.join(known)}"
    return f"error: command: got {name!r}, expected {expected}; python -m imagination describes all commands"


def main(arguments: list[str]) -> int:
    """List the commands or run one of them; return the exit code."""
    known = commands()
    if not arguments or arguments[0] in ("--help", "-h"):
        width = max(map(len, known))
        print(HELP.format(commands="\n".join(f"  {name:{width}}  {text}" for name, text in known.items())))
    elif arguments[0] in known:
        sys.argv[1:] = arguments[1:]
        runpy.run_module(f"imagination.{arguments[0]}", run_name="__main__", alter_sys=True)
    else:
        print(unknown(arguments[0], known), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

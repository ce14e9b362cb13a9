"""List plugins with what each adds, `check=true` imports their code: `python -m imagination.plugins`."""

import sys
from pathlib import Path

from imagination.config.plugin_registry import GROUP, activate, check, discover
from imagination.utils.errors import UserError


def main(arguments: list[str]) -> int:
    """List all plugins; the exit code is 1 if `check=true` found a broken one.

    Raises:
        UserError: on an unknown argument.
    """
    if unknown := set(arguments) - {"check=true", "check=false"}:
        raise UserError(f"plugins: got {' '.join(sorted(unknown))}, expected check=true or nothing")
    deep = "check=true" in arguments
    activate()
    found = discover()
    for plugin in found:
        if deep and not plugin.problem:
            plugin.problem = check(plugin)
        verdict = f"left out: {plugin.problem}" if plugin.problem else "adds " + ", ".join(plugin.options)
        print(f"{plugin.name}  ({plugin.origin})\n    {verdict}")
    if not found:
        print(
            f"No plugins: neither a folder {Path.cwd() / 'plugins'}/NAME nor a distribution in the group {GROUP}."
        )
    return int(deep and any(plugin.problem for plugin in found))


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except UserError as error:
        sys.exit(str(error))

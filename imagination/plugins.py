"""List plugins with the options they add: `python -m imagination.plugins [check=true]`."""

import sys
from pathlib import Path

from imagination.config.plugin_registry import GROUP, activate, check, discover
from imagination.utils.errors import UserError


def main(arguments: list[str]) -> int:
    """List all plugins; with `check=true`, import their code and return the exit code 1 if one is broken.

    Raises:
        UserError: if an argument is unknown.
    """
    if unknown := set(arguments) - {"check=true", "check=false"}:
        raise UserError(f"plugins: got {' '.join(sorted(unknown))}, expected check=true or nothing")
    import_code = "check=true" in arguments
    activate()
    plugins = discover()
    for plugin in plugins:
        if import_code and not plugin.problem:
            plugin.problem = check(plugin)
        status = f"left out: {plugin.problem}" if plugin.problem else "adds " + ", ".join(plugin.options)
        print(f"{plugin.name}  ({plugin.origin})\n    {status}")
    if not plugins:
        print(
            f"No plugins: found no folder {Path.cwd() / 'plugins'}/NAME and no distribution with the entry point "
            f"{GROUP}."
        )
    return int(import_code and any(plugin.problem for plugin in plugins))


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except UserError as error:
        sys.exit(str(error))

"""List plugins with the options they add: `python -m imagination.plugins [check=true]`."""

import sys
from pathlib import Path

from omegaconf import DictConfig

from imagination.config import plugin_registry
from imagination.config.contracts import check_plugin
from imagination.runs.command import command
from imagination.utils.code_hash import GROUP
from imagination.utils.errors import UserError


def validate(config: DictConfig) -> None:
    """Check the values of the config.

    Raises:
        UserError: if `check` is not a Boolean.
    """
    if not isinstance(config.check, bool):
        raise UserError(f"check: got {config.check!r}, expected true or false")


@command("plugins", validate)
def main(config: DictConfig) -> None:
    """List all plugins; with `check=true`, import their code and exit with code 1 if one is broken."""
    plugin_registry.activate()
    plugins = plugin_registry.discover()
    for plugin in plugins:
        if config.check and not plugin.problem:
            plugin.problem = check_plugin(plugin)
        status = f"left out: {plugin.problem}" if plugin.problem else "adds " + ", ".join(plugin.options)
        print(f"{plugin.name}  ({plugin.origin})\n    {status}")
    if not plugins:
        print(
            f"No plugins: found no folder {Path.cwd() / 'plugins'}/NAME and no distribution with the entry point "
            f"{GROUP}."
        )
    sys.exit(config.check and any(plugin.problem for plugin in plugins))


if __name__ == "__main__":
    main()

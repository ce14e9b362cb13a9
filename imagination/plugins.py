"""List, check or create plugins: `python -m imagination.plugins [check=true | new=NAME]`."""

import sys
from pathlib import Path

from omegaconf import DictConfig

from imagination.config import plugin_registry
from imagination.config.contracts import check_plugin
from imagination.config.new_plugin import NEXT_STEPS, write_plugin
from imagination.runs.command import command
from imagination.utils.code_hash import GROUP
from imagination.utils.errors import UserError


def validate(config: DictConfig) -> None:
    """Check the values of the config.

    Raises:
        UserError: if `check` is not a Boolean, or is true for a new plugin.
    """
    if not isinstance(config.check, bool):
        raise UserError(f"check: got {config.check!r}, expected true or false")
    if config.check and config.new is not None:
        raise UserError(
            "check: got true with new=…, expected one of them; check the plugin after it is written"
        )


@command("plugins", validate)
def main(config: DictConfig) -> None:
    """List all plugins, or write a new one; `check=true` imports their code and exits with code 1 if one is broken."""
    if config.new is not None:
        print(*write_plugin(config.new), NEXT_STEPS.format(name=config.new), sep="\n")
        return
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

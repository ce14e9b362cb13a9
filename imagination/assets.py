"""Download or list the assets of plugins: `python -m imagination.assets name=sweethome3d`."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from imagination.config.plugin_registry import provided
from imagination.runs.command import command
from imagination.utils.errors import UserError, check_choice

GROUP = "assets"
"""Config group in which plugins register providers: the `_target_` of each file is a class without arguments."""


@runtime_checkable
class Provider(Protocol):
    """Provider of assets."""

    def fetch(self) -> str:
        """Download the assets unless they exist; return a message with their location.

        Raises:
            UserError: if the download fails, with another way to get the assets.
        """

    def listing(self, folder: Path | None) -> list[str]:
        """Return one line per entry of the assets, with the reason for each entry that is not used.

        Args:
            folder: folder of scene files to list instead of the assets.

        Raises:
            UserError: if there is nothing to list.
        """


def validate(config: DictConfig) -> None:
    """Check that a plugin provides the assets.

    Raises:
        UserError: if no name is given, or no plugin provides assets of that name.
    """
    targets = providers()
    if not targets:
        raise UserError("name: found no plugin that provides assets; add a plugin to plugins/")
    if OmegaConf.is_missing(config, "name") or not config.name:
        raise UserError(
            f"name: got none, expected one of: {', '.join(sorted(targets))}; for example "
            f"python -m imagination.assets name={min(targets)}"
        )
    check_choice("name", str(config.name), targets)


def providers() -> dict[str, str]:
    """Return the `_target_` of each provider by name."""
    return {name: target for _, name, target in provided(GROUP)}


@command("assets", validate)
def main(config: DictConfig) -> None:
    """Download assets, or list them or a folder of scene files."""
    provider: Provider = get_class(providers()[str(config.name)])()
    if not config["list"]:
        print(provider.fetch())
    else:
        folder = None if config["list"] is True else Path(str(config["list"]))
        print("\n".join(provider.listing(folder)))


if __name__ == "__main__":
    main()

"""Download or list the assets of plugins: `python -m imagination.assets sweethome3d`."""

import sys
from pathlib import Path
from typing import Protocol, runtime_checkable

from imagination.config.plugin_registry import provided
from imagination.utils.errors import UserError, check_choice

GROUP = "assets"
"""Config group in which plugins register providers: the `_target_` of each file is a class without arguments."""

USAGE = "python -m imagination.assets NAME [list=true | list=FOLDER]"
"""Usage message."""


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


def main(arguments: list[str]) -> None:
    """Run the command.

    Raises:
        UserError: if a name or an argument is unknown, or the provider fails.
    """
    targets = {name: target for _, name, target in provided(GROUP)}
    if not arguments:
        print(f"{USAGE}\nNAME is one of: {', '.join(sorted(targets)) or '(no plugin provides assets)'}")
        return
    name, *rest = arguments
    if not targets:
        raise UserError(f"assets: got {name!r}, but no plugin provides assets; add a plugin to plugins/")
    check_choice("assets", name, targets)
    if len(rest) > 1 or not all(text.startswith("list=") for text in rest):
        raise UserError(f"assets: got {' '.join(rest)}, expected list=true, list=FOLDER or nothing")
    from hydra.utils import get_class

    provider: Provider = get_class(targets[name])()
    if rest:
        value = rest[0].removeprefix("list=")
        print("\n".join(provider.listing(None if value == "true" else Path(value))))
    else:
        print(provider.fetch())


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)

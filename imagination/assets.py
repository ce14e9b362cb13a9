"""Fetch or list what plugins need and the program does not carry: `python -m imagination.assets sweethome3d`."""

import sys
from pathlib import Path
from typing import Protocol, runtime_checkable

from imagination.config.plugin_registry import provided
from imagination.utils.errors import UserError, check_choice

GROUP = "assets"
"""Folder of a plugin's conf tree: each file's `_target_` is a provider without arguments."""
USAGE = "python -m imagination.assets NAME [list=true | list=FOLDER]"


@runtime_checkable
class Provider(Protocol):
    """Fetches the assets of one name."""

    def fetch(self) -> str:
        """Fetch them unless they are there; where they are.

        Raises:
            UserError: if they cannot be had, with how to get them elsewhere.
        """

    def listing(self, folder: Path | None) -> list[str]:
        """What they hold and what is left out with the reason, a line each; of a folder, what its files become.

        Raises:
            UserError: if there is nothing to list.
        """


def main(arguments: list[str]) -> None:
    """The command.

    Raises:
        UserError: on an unknown name or argument, or what the provider raises.
    """
    known = {name: target for _, name, target in provided(GROUP)}
    if not arguments:
        print(f"{USAGE}\nNAME is one of: {', '.join(sorted(known)) or '(no plugin offers any)'}")
        return
    name, *rest = arguments
    if not known:
        raise UserError(f"assets: got {name!r}, but no plugin offers assets; put one into plugins/")
    check_choice("assets", name, known)
    if len(rest) > 1 or not all(text.startswith("list=") for text in rest):
        raise UserError(f"assets: got {' '.join(rest)}, expected list=true, list=FOLDER or nothing")
    from hydra.utils import get_class

    provider: Provider = get_class(known[name])()
    if rest:
        asked = rest[0].removeprefix("list=")
        print("\n".join(provider.listing(None if asked == "true" else Path(asked))))
    else:
        print(provider.fetch())


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)

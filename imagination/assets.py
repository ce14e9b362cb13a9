"""Fetch or list what plugins need and the program does not carry: `python -m imagination.assets sweethome3d`."""

import sys
from typing import Protocol, runtime_checkable

import yaml

from imagination import plugins
from imagination.errors import UserError, check_choice

GROUP = "assets"
"""Folder of a plugin's conf tree: each file's `_target_` is a provider without arguments."""
USAGE = "python -m imagination.assets NAME [list=true]"


@runtime_checkable
class Provider(Protocol):
    """Fetches the assets of one name."""

    def fetch(self) -> str:
        """Fetch them unless they are there; where they are.

        Raises:
            UserError: if they cannot be had, with how to get them elsewhere.
        """

    def listing(self) -> list[str]:
        """What they hold, and what is left out with the reason, a line each."""


def providers() -> dict[str, str]:
    """What can be fetched, and the `_target_` of its provider."""
    found = {}
    for plugin in plugins.activate():
        assert plugin.conf is not None
        for path in sorted((plugin.conf / GROUP).glob("*.yaml")):
            found[path.stem] = str(yaml.safe_load(path.read_text())["_target_"])
    return found


def main(arguments: list[str]) -> None:
    """The command.

    Raises:
        UserError: on an unknown name or argument, or what the provider raises.
    """
    known = providers()
    if not arguments:
        print(f"{USAGE}\nNAME is one of: {', '.join(sorted(known)) or '(no plugin offers any)'}")
        return
    name, *rest = arguments
    if not known:
        raise UserError(f"assets: got {name!r}, but no plugin offers assets; put one into plugins/")
    check_choice("assets", name, known)
    if unknown := set(rest) - {"list=true", "list=false"}:
        raise UserError(f"assets: got {' '.join(sorted(unknown))}, expected list=true or nothing")
    from hydra.utils import get_class

    provider: Provider = get_class(known[name])()
    print("\n".join(provider.listing()) if "list=true" in rest else provider.fetch())


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)

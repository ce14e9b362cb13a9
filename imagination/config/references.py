"""Check of the references (${key}) in a config from a file, a few lines of which can expand to any amount of data."""

import re
from typing import Any

from imagination.utils.errors import UserError

REFERENCE = re.compile(r"\$\{(\.*)([\w-]+(?:\.[\w-]+)*)\}")
"""Pattern of a reference, relative with leading dots. Resolvers and nested references do not match."""

MAX_SIZE = 1_000_000
"""Largest size of a config with its references replaced: number of its values and characters."""

MAX_HOPS = 8
"""Largest number of references on the way to a value: in ${a.b}, `a` may be a reference itself."""

Place = tuple[str, ...]
"""Keys on the way to a value."""


def check_references(values: dict[str, Any]) -> None:
    """Check that texts hold no resolvers, such as ${oc.env:…}, and that references expand to little data.

    Args:
        values: plain values of a config, without anchors of YAML.

    Raises:
        UserError: if a text has a resolver or a nested reference, references are circular, or they expand to too much.
    """
    try:
        size = _Sizes(values).size(())
    except RecursionError as error:
        raise UserError(
            "config: got references that are circular or too deep, expected plain ones"
        ) from error
    if size > MAX_SIZE:
        raise UserError(
            f"config: got references that expand to more than {MAX_SIZE} values and characters, expected fewer"
        )


class _Sizes:
    """Sizes of the values of a config with their references replaced."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.values = values
        self.known: dict[Place, int] = {}

    def size(self, place: Place) -> int:
        """Return the size of the value at a place; 0 if there is none, which OmegaConf reports."""
        if place not in self.known:
            node = self._at(place)
            if isinstance(node, (dict, list)):
                keys = node if isinstance(node, dict) else range(len(node))
                self.known[place] = 1 + sum(self.size((*place, str(key))) for key in keys)
            elif isinstance(node, str):
                _check_text(node)
                targets = [_target(place, match) for match in REFERENCE.finditer(node)]
                self.known[place] = 1 + len(node) + sum(map(self.size, targets))
            else:
                self.known[place] = int(node is not None)
        return self.known[place]

    def _at(self, place: Place, hops: int = MAX_HOPS) -> Any:
        """Return the value at a place, through the references on the way to it."""
        node: Any = self.values
        for depth, key in enumerate(place):
            if isinstance(node, str) and (match := REFERENCE.fullmatch(node)):
                if not hops:
                    raise RecursionError
                return self._at((*_target(place[:depth], match), *place[depth:]), hops - 1)
            if isinstance(node, list):
                node = node[int(key)] if key.isdecimal() and int(key) < len(node) else None
            else:
                node = node.get(key) if isinstance(node, dict) else None
        return node


def _target(place: Place, reference: re.Match[str]) -> Place:
    """Return the place that a reference at `place` refers to."""
    dots, key = reference.groups()
    parent = place[: max(0, len(place) - len(dots))] if dots else ()
    return (*parent, *key.split("."))


def _check_text(text: str) -> None:
    if "${" in (rest := REFERENCE.sub("", text)):
        call = rest[rest.index("${") :][:40]
        raise UserError(
            f"config: got a value with {call!r}, expected constants and references; start a new run"
        )

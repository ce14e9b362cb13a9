"""The category table: the one place where classes are known."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from imagination.utils.errors import UserError, check_choice


@dataclass(frozen=True)
class Category:
    """One kind of object.

    Attributes:
        name: as used in configs and tables, e.g. "chair".
        colour: RGB, 0 to 255, for drawing only.
        aliases: for each scene source, the labels of that source that belong to this category.
    """

    name: str
    colour: tuple[int, int, int]
    aliases: Mapping[str, Sequence[str]] = field(default_factory=dict)


class CategoryTable:
    """Categories in order. A category's index in images of categories is its row + 1; 0 means none.

    Raises:
        UserError: on an empty table, a repeated name, or a label that two categories claim.
    """

    def __init__(self, rows: Sequence[Category]) -> None:
        if not rows:
            raise UserError("categories: got an empty table, expected at least one row (see conf/categories)")
        names = [row.name for row in rows]
        if len(set(names)) < len(names):
            raise UserError(f"categories: got the names {names}, expected each name once")
        self.rows = tuple(rows)
        self._by_label: dict[tuple[str, str], str] = {}
        for row in rows:
            for source, labels in row.aliases.items():
                for label in labels:
                    other = self._by_label.setdefault((source, label), row.name)
                    if other != row.name:
                        raise UserError(
                            f"categories: label {label!r} of {source} belongs to both {other} and {row.name}; "
                            "leave it in one of them"
                        )

    @classmethod
    def from_config(cls, config: Mapping[str, Mapping[str, Any]]) -> "CategoryTable":
        """Build the table from conf/categories: {name: {colour: [r, g, b], aliases: {source: [label]}}}."""
        rows = [Category(name, tuple(row["colour"]), row.get("aliases", {})) for name, row in config.items()]
        return cls(rows)

    def __iter__(self) -> Iterator[Category]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def names(self) -> list[str]:
        return [row.name for row in self.rows]

    def index(self, name: str) -> int:
        """Index of a category in images of categories: its row + 1.

        Raises:
            UserError: if no such category exists, with the names that do.
        """
        check_choice("category", name, self.names)
        return self.names.index(name) + 1

    def of_label(self, source: str, label: str) -> str | None:
        """Category of a label that a scene source uses, None if it belongs to none."""
        return self._by_label.get((source, label))

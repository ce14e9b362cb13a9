"""Category table, the only definition of the classes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from imagination.utils.errors import UserError, check_choice


@dataclass(frozen=True)
class Category:
    """Category of objects.

    Attributes:
        name: name in configurations and tables, e.g. "chair".
        colour: RGB colour for figures, 0 to 255.
        aliases: labels of this category in each scene source.
    """

    name: str
    colour: tuple[int, int, int]
    aliases: Mapping[str, Sequence[str]] = field(default_factory=dict)


class CategoryTable:
    """Ordered table of categories; the index of a category in segmented images is its row + 1, 0 is background.

    Raises:
        UserError: if the table is empty, a name is repeated, or a label belongs to two categories.
    """

    def __init__(self, rows: Sequence[Category]) -> None:
        if not rows:
            raise UserError("categories: got an empty table, expected at least one row (see conf/categories)")
        names = [row.name for row in rows]
        if len(set(names)) < len(names):
            raise UserError(f"categories: got the names {names}, expected unique names")
        self.rows = tuple(rows)
        self._by_label: dict[tuple[str, str], str] = {}
        for row in rows:
            for source, labels in row.aliases.items():
                for label in labels:
                    owner = self._by_label.setdefault((source, label), row.name)
                    if owner != row.name:
                        raise UserError(
                            f"categories: got label {label!r} of {source} in both {owner} and {row.name}, expected it "
                            "in one of them; remove it from the other"
                        )

    @classmethod
    def from_config(cls, config: Mapping[str, Mapping[str, Any]]) -> "CategoryTable":
        """Build the table from a configuration {name: {colour: [r, g, b], aliases: {source: [label]}}}."""
        rows = [Category(name, tuple(row["colour"]), row.get("aliases", {})) for name, row in config.items()]
        return cls(rows)

    def __iter__(self) -> Iterator[Category]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def names(self) -> list[str]:
        return [row.name for row in self.rows]

    @property
    def labels(self) -> list[list[Any]]:
        """Name and labels of each row, in the order of the rows, which determines the indices in images and maps."""
        return [
            [row.name, {source: list(labels) for source, labels in row.aliases.items()}] for row in self.rows
        ]

    def index(self, name: str) -> int:
        """Return the index of a category in segmented images: its row + 1.

        Raises:
            UserError: if there is no such category; the message lists the names.
        """
        check_choice("category", name, self.names)
        return self.names.index(name) + 1

    def of_label(self, source: str, label: str) -> str | None:
        """Return the category of a label of a scene source, or None."""
        return self._by_label.get((source, label))

"""The scene source of procedural homes."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from imagination.scenes import free_space as free_space_module
from imagination.scenes.categories import CategoryTable
from imagination.scenes.procedural.furniture.stock import LABELS, Furniture, ProceduralFurniture
from imagination.scenes.procedural.scene_builder import build_home
from imagination.scenes.scene import Scene
from imagination.scenes.source import SPLITS, Credit, Split
from imagination.utils.errors import UserError, check_range

SOURCE = "procedural"

MAX_SCENES = 9999
"""Homes of a split."""

SPARE = "known"
"""What homes with furniture that is known from training, none of which is trained on, are called."""


class ProceduralHomes:
    """Furnished homes made by rule; a home depends only on the seed, its split and its number.

    Args:
        seed: of the homes, apart from the seed of training, so that runs with different seeds share homes.
        splits: number of homes of each split.
        categories: which labels belong to which category.
        robot_radius: of the robot that must get through every room, metres.
        required: categories that must be among those that homes can contain.
        furniture: where the pieces come from; made by rule unless given.

    Raises:
        UserError: on a value out of range, a label that no home contains, or a required category without labels.
    """

    name = SOURCE

    def __init__(
        self,
        seed: int,
        splits: Mapping[str, int],
        categories: CategoryTable,
        robot_radius: float,
        required: Sequence[str] = (),
        furniture: Furniture | None = None,
    ) -> None:
        check_range("procedural homes: seed", seed, 0, 2**63 - 1)
        check_range("procedural homes: robot_radius", robot_radius, 0.05, 0.35, "m")
        if set(splits) != set(SPLITS):
            raise UserError(f"procedural homes: got splits {sorted(splits)}, expected {', '.join(SPLITS)}")
        for split, count in splits.items():
            check_range(f"procedural homes: splits.{split}", count, 0, MAX_SCENES, "homes")
        for category in categories:
            unknown = sorted(set(category.aliases.get(SOURCE, ())) - set(LABELS))
            if unknown:
                raise UserError(
                    f"categories: {category.name} claims {', '.join(unknown)} of {SOURCE}, expected labels among: "
                    f"{', '.join(sorted(LABELS))}"
                )
        self._seed, self._counts = seed, dict(splits)
        self._categories, self._robot_radius = categories, robot_radius
        self._furniture = furniture or ProceduralFurniture()
        for name in required:
            categories.index(name)
            if name not in self.categories():
                raise UserError(
                    f"category {name}: no procedural home contains it; list its labels under aliases.{SOURCE} "
                    f"(homes know: {', '.join(sorted(LABELS))})"
                )

    def categories(self) -> tuple[str, ...]:
        """Categories that homes of every split contain, without loading any."""
        return tuple(category.name for category in self._categories if category.aliases.get(SOURCE))

    def scenes(self, split: Split) -> list[str]:
        """Names of a split's homes.

        Raises:
            UserError: if the split has none.
        """
        if split not in SPLITS:
            raise UserError(f"split: got {split!r}, expected one of: {', '.join(SPLITS)}")
        if self._counts[split] == 0:
            raise UserError(
                f"split {split}: has no homes; set splits.{split} of the procedural homes to at least 1"
            )
        return [f"{split}_{number:04d}" for number in range(self._counts[split])]

    def spare(self, count: int) -> list[str]:
        """Names of homes furnished as training's whose numbers lie beyond all of training's."""
        check_range("procedural homes: spare homes", count, 1, MAX_SCENES, "homes")
        return [f"{SPARE}_{number:04d}" for number in range(count)]

    def load(self, scene: str) -> Scene:
        """Build one home.

        Raises:
            UserError: if there is no such home.
        """
        split, number = self._parse(scene)
        return build_home(
            scene, self._seed, split, number, self._categories, self._robot_radius, self._furniture
        )

    def fingerprint(self, scene: str) -> str:
        """Changes with the seed, the home, the robot, the categories' labels, the furniture and the builders' code."""
        self._parse(scene)
        aliases = [(category.name, sorted(category.aliases.get(SOURCE, ()))) for category in self._categories]
        furniture = self._furniture.fingerprint()
        text = repr((SOURCE, self._seed, scene, self._robot_radius, aliases, furniture, _code_version()))
        return hashlib.sha256(text.encode()).hexdigest()

    def credits(self) -> Sequence[Credit]:
        """The models of furniture that others made."""
        return self._furniture.credits()

    def _parse(self, scene: str) -> tuple[Split, int]:
        for split in SPLITS:
            if self._counts[split] and scene in self.scenes(split):
                return split, int(scene.rsplit("_", 1)[1])
        if re.fullmatch(rf"{SPARE}_\d{{4}}", scene):
            return "train", MAX_SCENES + 1 + int(scene.rsplit("_", 1)[1])
        have = ", ".join(f"{split}_0000 to {split}_{n - 1:04d}" for split, n in self._counts.items() if n)
        raise UserError(f"scene: got {scene!r}, expected one of: {have or '(no homes are configured)'}")


@cache
def _code_version() -> str:
    """Hash of the code that homes come from, and of the library whose random numbers they use."""
    digest = hashlib.sha256(np.__version__.encode())
    for path in [*sorted(Path(__file__).parent.glob("*.py")), Path(free_space_module.__file__)]:
        digest.update(path.read_bytes())
    return digest.hexdigest()

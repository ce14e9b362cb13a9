"""Scene source of procedural homes."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from imagination.scenes.building_blocks.furniture_source import LABELS, SOURCE, Furniture
from imagination.scenes.categories import CategoryTable
from imagination.scenes.procedural.furniture.procedural_furniture import ProceduralFurniture
from imagination.scenes.procedural.scene_builder import build_home
from imagination.scenes.scene import Scene
from imagination.scenes.source import SPLITS, Credit, Split
from imagination.utils.code_hash import core_hash
from imagination.utils.errors import UserError, check_range

MAX_SCENES = 9999
"""Maximum number of homes in a split."""

SPARE = "known"
"""Name prefix of homes that have training furniture but are not used in training."""

BUILDERS = (
    *(
        "scenes/procedural",
        "scenes/building_blocks",
        "scenes/free_space.py",
        "scenes/scene.py",
        "scenes/categories.py",
    ),
    *("scenes/source.py", "geometry/grid.py", "geometry/pose.py", "utils/jit.py"),
)
"""Packages and modules of the core that build homes."""


class ProceduralHomes:
    """Source of furnished procedural homes; a home depends only on the seed, its split and its number.

    Args:
        seed: seed of the homes, independent of the training seed, so that runs with different seeds use the same homes.
        splits: number of homes in each split.
        categories: category table with the labels of each category.
        robot_radius: radius of the robot that must reach every room, metres.
        required: categories that homes must be able to contain.
        furniture: source of the furniture; procedural if None.

    Raises:
        UserError: if a value is out of range, a label does not exist, or a required category has no label.
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
                    f"categories: got labels {', '.join(unknown)} of {SOURCE} for {category.name}, expected some of: "
                    f"{', '.join(sorted(LABELS))}"
                )
        self._seed, self._counts = seed, dict(splits)
        self._categories, self._robot_radius = categories, robot_radius
        self._furniture = furniture or ProceduralFurniture()
        for name in required:
            categories.index(name)
            if name not in self.categories():
                raise UserError(
                    f"category {name}: got no labels of procedural homes, expected at least one under "
                    f"aliases.{SOURCE}; add some of: {', '.join(sorted(LABELS))}"
                )

    def categories(self) -> tuple[str, ...]:
        """Return the categories that homes of every split contain, without loading a home."""
        return tuple(category.name for category in self._categories if category.aliases.get(SOURCE))

    def scenes(self, split: Split) -> list[str]:
        """Return the names of the homes of a split.

        Raises:
            UserError: if the split is empty.
        """
        if split not in SPLITS:
            raise UserError(f"split: got {split!r}, expected one of: {', '.join(SPLITS)}")
        if self._counts[split] == 0:
            raise UserError(
                f"split {split}: got 0 homes, expected at least 1; raise splits.{split} of the procedural homes"
            )
        return [f"{split}_{number:04d}" for number in range(self._counts[split])]

    def spare(self, count: int) -> list[str]:
        """Return the names of homes that are furnished as in training and have numbers above those of training."""
        check_range("procedural homes: spare homes", count, 1, MAX_SCENES, "homes")
        return [f"{SPARE}_{number:04d}" for number in range(count)]

    def load(self, scene: str) -> Scene:
        """Build one home.

        Raises:
            UserError: if the home does not exist.
        """
        split, number = self._parse(scene)
        return build_home(
            scene, self._seed, split, number, self._categories, self._robot_radius, self._furniture
        )

    def identity(self, scene: str) -> str:
        """Return the seed and the name of a home, whatever its furniture."""
        self._parse(scene)
        return f"{self.name} seed={self._seed} {scene}"

    def fingerprint(self, scene: str) -> str:
        """Return a hash of the seed, home, robot, category labels, furniture and code of the builders."""
        self._parse(scene)
        aliases = [(category.name, sorted(category.aliases.get(SOURCE, ()))) for category in self._categories]
        furniture = self._furniture.fingerprint()
        text = repr((SOURCE, self._seed, scene, self._robot_radius, aliases, furniture, _code_version()))
        return hashlib.sha256(text.encode()).hexdigest()

    def credits(self) -> Sequence[Credit]:
        """Return the attributions of third-party furniture models."""
        return self._furniture.credits()

    def _parse(self, scene: str) -> tuple[Split, int]:
        """Return the split whose furniture a home has and its number."""
        for split in SPLITS:
            if self._counts[split] and scene in self.scenes(split):
                return split, int(scene.rsplit("_", 1)[1])
        if re.fullmatch(rf"{SPARE}_\d{{4}}", scene):
            return "train", MAX_SCENES + 1 + int(scene.rsplit("_", 1)[1])
        available = ", ".join(
            f"{split}_0000 to {split}_{n - 1:04d}" for split, n in self._counts.items() if n
        )
        raise UserError(f"scene: got {scene!r}, expected one of: {available or '(no homes are configured)'}")


@cache
def _code_version() -> str:
    """Return the hash of the code that builds homes and of the version of NumPy, whose random numbers it uses."""
    return f"{core_hash(BUILDERS)} numpy {np.__version__}"

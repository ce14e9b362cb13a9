"""Palette of surface finishes of one home."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imagination.scenes.building_blocks.textures import (
    Image,
    carpet,
    fabric,
    herringbone,
    marble,
    planks,
    plaster,
    sky,
    stripes,
    tiles,
    wallpaper,
    wood,
)
from imagination.scenes.scene import Material

Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Finish:
    """Finish of a surface.

    Attributes:
        material: colour and texture.
        tile: side of one texture tile, metres.
    """

    material: Material
    tile: float = 1.0


WOODS: list[Colour] = [
    (0.80, 0.62, 0.42), (0.66, 0.46, 0.28), (0.42, 0.27, 0.17), (0.27, 0.18, 0.13),
    (0.88, 0.76, 0.58), (0.72, 0.50, 0.34), (0.55, 0.48, 0.42), (0.93, 0.92, 0.90),
]  # fmt: skip
METALS: list[Colour] = [
    (0.75, 0.76, 0.78),
    (0.16, 0.16, 0.17),
    (0.45, 0.46, 0.48),
    (0.78, 0.66, 0.42),
    (0.92, 0.92, 0.93),
]
LEATHERS: list[Colour] = [(0.14, 0.12, 0.12), (0.40, 0.24, 0.15), (0.62, 0.45, 0.30), (0.85, 0.82, 0.76)]
WALLS: list[Colour] = [
    (0.96, 0.95, 0.92), (0.93, 0.90, 0.84), (0.86, 0.89, 0.90), (0.84, 0.88, 0.81),
    (0.94, 0.87, 0.80), (0.80, 0.82, 0.86), (0.72, 0.78, 0.76), (0.90, 0.84, 0.86),
]  # fmt: skip


class Palette:
    """Finishes of one home: a few of each kind, so that the surfaces of a home match."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.woods = self._several(wood, 3, lambda: self._near(WOODS), 0.7)
        self.metals = self._several(None, 2, lambda: self._near(METALS), 1.0)
        self.plastics = self._several(None, 4, self._any, 1.0)
        self.leathers = self._several(carpet, 2, lambda: self._near(LEATHERS), 0.4)
        self.fabrics = self._several(fabric, 5, self._any, 0.25) + self._several(stripes, 1, self._any, 0.5)
        self.linens = self._several(fabric, 2, self._pale, 0.4)
        self.paints = self._several(None, 3, self._pale, 1.0)
        self.stones = self._several(marble, 2, lambda: self._near([*METALS[:3], (0.9, 0.88, 0.84)]), 1.0)
        self.walls = self._several(plaster, 3, lambda: self._near(WALLS), 1.5)
        self.walls += self._several(wallpaper, 1, lambda: self._near(WALLS), 0.8)
        self.ceiling = Finish(Material((0.97, 0.97, 0.96)))
        self.glass = Finish(Material((1.0, 1.0, 1.0), sky(rng)), 1.0)
        self.leaves = Finish(Material((0.25, 0.48, 0.22), carpet(rng)), 0.3)
        self.dark = Finish(Material((0.07, 0.07, 0.08)))
        self.white = Finish(Material((0.95, 0.95, 0.95)))

    def pick(self, finishes: list[Finish]) -> Finish:
        """Draw one of several finishes."""
        return finishes[int(self._rng.integers(len(finishes)))]

    def new_finish(
        self, pattern: Callable[[np.random.Generator], Image] | None, colour: Colour, tile: float
    ) -> Finish:
        """Return a new finish with a texture drawn from `pattern`."""
        return Finish(Material(colour, None if pattern is None else pattern(self._rng)), tile)

    def floor(self, wet: bool) -> Finish:
        """Draw a floor finish: tiles in wet rooms, else planks, herringbone parquet, carpet or tiles."""
        if wet or self._rng.random() < 0.12:
            return self.new_finish(
                tiles, self._near([(0.85, 0.83, 0.80), (0.6, 0.6, 0.6), (0.78, 0.70, 0.60)]), 1.4
            )
        kind = int(self._rng.integers(4))
        if kind == 3:
            return self.new_finish(
                carpet, self._near([(0.70, 0.66, 0.60), (0.45, 0.47, 0.52), (0.60, 0.50, 0.45)]), 0.6
            )
        return self.new_finish(herringbone if kind == 2 else planks, self._near(WOODS[:7]), 1.1)

    def accent(self) -> Finish:
        """Draw a plain colour for small objects."""
        return Finish(Material(self._any()))

    def _several(
        self,
        pattern: Callable[[np.random.Generator], Image] | None,
        count: int,
        colour: Callable[[], Colour],
        tile: float,
    ) -> list[Finish]:
        """Draw `count` finishes with the same texture."""
        image = None if pattern is None else pattern(self._rng)
        return [Finish(Material(colour(), image), tile) for _ in range(count)]

    def _near(self, colours: list[Colour]) -> Colour:
        """Draw a colour near one of several."""
        base = np.array(colours[int(self._rng.integers(len(colours)))])
        red, green, blue = np.clip(
            base * self._rng.uniform(0.88, 1.08) + self._rng.normal(0, 0.015, 3), 0, 1
        ).tolist()
        return red, green, blue

    def _any(self) -> Colour:
        """Draw any colour, usually muted."""
        grey, tint = self._rng.uniform(0.12, 0.9), self._rng.uniform(-1, 1, 3) * self._rng.uniform(0.02, 0.24)
        red, green, blue = np.clip(grey + tint, 0.03, 0.97).tolist()
        return red, green, blue

    def _pale(self) -> Colour:
        """Draw a pale colour."""
        red, green, blue = np.clip(
            self._rng.uniform(0.78, 0.97) + self._rng.uniform(-0.06, 0.06, 3), 0, 1
        ).tolist()
        return red, green, blue

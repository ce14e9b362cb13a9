"""Small images that repeat without a seam, and the finishes of one home's surfaces."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from imagination.scenes.scene import Material

SIDE = 128
"""Pixels a side of a texture."""

Image = UInt8[np.ndarray, "s s 3"]
Grey = Float[np.ndarray, "s s"]
Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Finish:
    """How a surface looks.

    Attributes:
        material: colour and texture.
        tile: metres that one copy of the texture spans.
    """

    material: Material
    tile: float = 1.0


def noise(rng: np.random.Generator, across: float, along: float) -> Grey:
    """Smooth noise that repeats, mean 0 and deviation 1; features of `across` x `along` of the image (u, v)."""
    u, v = np.fft.fftfreq(SIDE)[None, :] * SIDE, np.fft.fftfreq(SIDE)[:, None] * SIDE
    weight = np.exp(-((u * across) ** 2) - (v * along) ** 2)
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIDE, SIDE))) * weight).real
    return np.asarray((field - field.mean()) / max(float(field.std()), 1e-9))


def _image(grey: Grey, tint: Grey | None = None) -> Image:
    """A brightness around 1 as an image, 1 at level 220 to leave head room; `tint` reddens where it is positive."""
    tint = np.zeros_like(grey) if tint is None else tint
    channels = np.stack([grey * (1 + tint), grey, grey * (1 - tint)], axis=-1)
    return _pixels(channels * 220)


def _pixels(levels: Float[np.ndarray, "s s 3"]) -> Image:
    return np.asarray(np.clip(levels, 0, 255), np.uint8)


def wood(rng: np.random.Generator) -> Image:
    """Grain along v."""
    rings = np.sin(6.0 * noise(rng, 0.06, 0.9) + 2.5 * noise(rng, 0.25, 0.9))
    return _image(1 + 0.06 * rings + 0.05 * noise(rng, 0.012, 0.25), 0.04 * noise(rng, 0.1, 0.8))


def planks(rng: np.random.Generator) -> Image:
    """Boards of a floor along v, each with its own shade and a joint."""
    boards = int(rng.integers(5, 8))
    row, column = np.indices((SIDE, SIDE))
    board = column * boards // SIDE
    shade, joint = rng.normal(0, 0.07, boards)[board], rng.integers(0, SIDE, boards)[board]
    gap = (np.abs(column - np.round((board + 0.5) * SIDE / boards)) > SIDE / boards / 2 - 1) | (row == joint)
    return _image(
        (1 + shade + 0.05 * noise(rng, 0.01, 0.25)) * np.where(gap, 0.6, 1.0), 0.03 * noise(rng, 0.08, 0.5)
    )


def herringbone(rng: np.random.Generator) -> Image:
    """Parquet of short blocks laid in alternate directions."""
    row, column = np.indices((SIDE, SIDE))
    block = SIDE // 4
    turned = (row // block + column // block) % 2 == 1
    strip = np.where(turned, row, column) % (block // 4)
    number = (row // block * 4 + column // block) * 4 + np.where(turned, row, column) % block // (block // 4)
    shade = rng.normal(0, 0.08, number.max() + 1)[number]
    return _image((1 + shade + 0.03 * noise(rng, 0.03, 0.03)) * np.where(strip == 0, 0.65, 1.0))


def tiles(rng: np.random.Generator) -> Image:
    """Square tiles, four by four, with grout."""
    row, column = np.indices((SIDE, SIDE))
    side = SIDE // 4
    shade = rng.normal(0, 0.03, (4, 4))[row // side, column // side]
    grout = (row % side < 2) | (column % side < 2)
    return _image((1 + shade + 0.03 * noise(rng, 0.1, 0.1)) * np.where(grout, 0.72, 1.0))


def plaster(rng: np.random.Generator) -> Image:
    """Painted walls: almost plain."""
    return _image(1 + 0.012 * noise(rng, 0.02, 0.02) + 0.015 * noise(rng, 0.2, 0.2))


def wallpaper(rng: np.random.Generator) -> Image:
    """Soft stripes or dots on a wall."""
    row, column = np.indices((SIDE, SIDE)) / SIDE * 2 * np.pi
    count = int(rng.integers(3, 8))
    stripes = np.sign(np.sin(count * column))
    dots = np.sin(count * column) * np.sin(count * row) > 0.6
    pattern = stripes if rng.random() < 0.5 else dots.astype(np.float64)
    return _image(1 + 0.06 * pattern + 0.01 * noise(rng, 0.02, 0.02))


def fabric(rng: np.random.Generator) -> Image:
    """A weave."""
    row, column = np.indices((SIDE, SIDE))
    weave = ((row // 2 + column // 2) % 2) * 2.0 - 1
    return _image(1 + 0.05 * weave + 0.05 * noise(rng, 0.008, 0.008) + 0.03 * noise(rng, 0.1, 0.1))


def stripes(rng: np.random.Generator) -> Image:
    """Striped cloth for curtains, covers and rugs."""
    column = np.indices((SIDE, SIDE))[1]
    bands = rng.integers(4, 9)
    dark = (column * bands // SIDE) % 2
    return _image(np.where(dark, rng.uniform(0.55, 0.8), 1.0) + 0.04 * noise(rng, 0.008, 0.008))


def carpet(rng: np.random.Generator) -> Image:
    """A pile."""
    return _image(1 + 0.09 * noise(rng, 0.006, 0.006) + 0.04 * noise(rng, 0.1, 0.1))


def rug(rng: np.random.Generator) -> Image:
    """A pattern of lozenges within a border, spread once over a rug."""
    row, column = np.indices((SIDE, SIDE))
    edge = np.minimum.reduce([row, column, SIDE - 1 - row, SIDE - 1 - column])
    lozenge = (np.abs(row - SIDE / 2) + np.abs(column - SIDE / 2)) // int(rng.integers(6, 16)) % 2
    levels = rng.uniform(0.45, 1.1, 4)
    grey = np.where(lozenge > 0, levels[0], levels[1])
    grey = np.where(edge < 14, levels[2], grey)
    grey = np.where((edge < 18) & (edge > 12), levels[3], grey)
    return _image(grey + 0.06 * noise(rng, 0.006, 0.006), 0.15 * np.where(lozenge > 0, 1.0, -1.0))


def marble(rng: np.random.Generator) -> Image:
    """Stone of worktops."""
    veins = np.abs(noise(rng, 0.1, 0.1)) < 0.06
    return _image(1 + 0.04 * noise(rng, 0.15, 0.15) + 0.05 * noise(rng, 0.01, 0.01) - 0.12 * veins)


def painting(rng: np.random.Generator) -> Image:
    """Something to hang on a wall: patches of colour over a horizon."""
    first, second = noise(rng, 0.25, 0.12), noise(rng, 0.12, 0.12)
    shades = rng.uniform(0.15, 1.0, (4, 3))
    choice = (first > 0).astype(int) * 2 + (second + np.linspace(-1, 1, SIDE)[:, None] > 0)
    grain = 1 + 0.08 * noise(rng, 0.02, 0.02)[..., None]
    return _pixels(shades[choice] * grain * 235)


def sky(rng: np.random.Generator) -> Image:
    """What a window shows: bright above, a blurred skyline or trees below."""
    height = np.linspace(0, 1, SIDE)[::-1, None] + 0 * np.zeros((1, SIDE))
    ground = height < 0.32 + 0.08 * noise(rng, 0.1, 4.0)
    day = np.stack(
        [0.80 + 0.12 * (1 - height), 0.88 + 0.08 * (1 - height), np.full_like(height, 0.99)], axis=-1
    )
    land = np.array([0.45, 0.55, 0.42]) * (1 + 0.12 * noise(rng, 0.05, 0.05))[..., None]
    return _pixels(np.where(ground[..., None], land, day) * 255)


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
    """The finishes of one home: a handful of each kind, so that things in a home go together."""

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
        """One of several finishes."""
        return finishes[int(self._rng.integers(len(finishes)))]

    def one(
        self, pattern: Callable[[np.random.Generator], Image] | None, colour: Colour, tile: float
    ) -> Finish:
        """A finish of its own."""
        return Finish(Material(colour, None if pattern is None else pattern(self._rng)), tile)

    def floor(self, wet: bool) -> Finish:
        """A floor: tiles where it gets wet, else boards, parquet, carpet or tiles."""
        if wet or self._rng.random() < 0.12:
            return self.one(tiles, self._near([(0.85, 0.83, 0.80), (0.6, 0.6, 0.6), (0.78, 0.70, 0.60)]), 1.4)
        kind = int(self._rng.integers(4))
        if kind == 3:
            return self.one(
                carpet, self._near([(0.70, 0.66, 0.60), (0.45, 0.47, 0.52), (0.60, 0.50, 0.45)]), 0.6
            )
        return self.one(herringbone if kind == 2 else planks, self._near(WOODS[:7]), 1.1)

    def accent(self) -> Finish:
        """A plain colour for small things."""
        return Finish(Material(self._any()))

    def _several(
        self,
        pattern: Callable[[np.random.Generator], Image] | None,
        count: int,
        colour: Callable[[], Colour],
        tile: float,
    ) -> list[Finish]:
        image = None if pattern is None else pattern(self._rng)
        return [Finish(Material(colour(), image), tile) for _ in range(count)]

    def _near(self, colours: list[Colour]) -> Colour:
        base = np.array(colours[int(self._rng.integers(len(colours)))])
        red, green, blue = np.clip(
            base * self._rng.uniform(0.88, 1.08) + self._rng.normal(0, 0.015, 3), 0, 1
        ).tolist()
        return red, green, blue

    def _any(self) -> Colour:
        """Any colour, mostly muted."""
        grey, tint = self._rng.uniform(0.12, 0.9), self._rng.uniform(-1, 1, 3) * self._rng.uniform(0.02, 0.3)
        red, green, blue = np.clip(grey + tint, 0.03, 0.97).tolist()
        return red, green, blue

    def _pale(self) -> Colour:
        red, green, blue = np.clip(
            self._rng.uniform(0.78, 0.97) + self._rng.uniform(-0.06, 0.06, 3), 0, 1
        ).tolist()
        return red, green, blue

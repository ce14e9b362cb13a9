"""Storage furniture, and fittings of kitchen and bathroom; the front is at +y."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import Assembly, Surface
from imagination.scenes.building_blocks.shapes import bent, box, cushion, prism, rounded, tube

Rng = np.random.Generator


def _doors(
    case: Assembly, palette: Palette, width: float, depth: float, low: float, high: float, count: int
) -> None:
    """Add doors or drawer fronts with handles to the front of a case."""
    finish, metal = case.parts[0][1], palette.pick(palette.metals)
    step = width / count
    for number in range(count):
        x = (number - (count - 1) / 2) * step
        case.add(box(step - 0.012, 0.018, high - low - 0.012), finish, (x, depth / 2 + 0.009, low + 0.006))
        side = step * (0.4 if number % 2 == 0 else -0.4)
        case.add(
            box(0.014, 0.025, min(0.2, (high - low) * 0.3)),
            metal,
            (x + side, depth / 2 + 0.027, (low + high) / 2),
        )


def _wardrobe(case: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth, height = rng.uniform(0.9, 2.0), rng.uniform(0.52, 0.62), rng.uniform(1.85, 2.25)
    case.add(box(width, depth, height), palette.pick(palette.woods + palette.paints))
    _doors(case, palette, width, depth, 0.07, height - 0.02, max(2, round(width / 0.5)))


def _drawers(
    case: Assembly, wood: int, palette: Palette, width: float, depth: float, height: float, rows: int
) -> None:
    """Build a chest with `rows` rows of drawers."""
    case.add(box(width, depth, height - 0.06), palette.woods[wood % len(palette.woods)], (0, 0, 0.06))
    case.add(box(width * 0.9, depth * 0.9, 0.06), palette.dark)
    step = (height - 0.1) / rows
    for row in range(rows):
        _doors(
            case,
            palette,
            width - 0.02,
            depth,
            0.08 + row * step,
            0.08 + (row + 1) * step,
            2 if width > 0.9 else 1,
        )
    case.surfaces.append(
        Surface(-width / 2 + 0.03, -depth / 2 + 0.03, width / 2 - 0.03, depth / 2 - 0.03, height)
    )


def _dresser(case: Assembly, palette: Palette, rng: Rng) -> None:
    _drawers(
        case,
        int(rng.integers(9)),
        palette,
        rng.uniform(0.75, 1.5),
        rng.uniform(0.4, 0.5),
        rng.uniform(0.75, 1.1),
        3,
    )


def _nightstand(case: Assembly, palette: Palette, rng: Rng) -> None:
    _drawers(case, 0, palette, rng.uniform(0.38, 0.52), rng.uniform(0.34, 0.42), rng.uniform(0.42, 0.6), 2)


def _sideboard(case: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth, height = rng.uniform(1.1, 1.8), rng.uniform(0.38, 0.48), rng.uniform(0.72, 0.95)
    lift = rng.uniform(0.06, 0.18)
    case.add(box(width, depth, height - lift), palette.pick(palette.woods), (0, 0, lift))
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        case.add(box(0.04, 0.04, lift), palette.dark, (sx * (width / 2 - 0.06), sy * (depth / 2 - 0.06), 0))
    _doors(case, palette, width, depth, lift + 0.02, height - 0.03, round(width / 0.45))
    case.surfaces.append(
        Surface(-width / 2 + 0.05, -depth / 2 + 0.05, width / 2 - 0.05, depth / 2 - 0.05, height)
    )


def _tv_stand(case: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth, height = rng.uniform(1.1, 1.8), rng.uniform(0.36, 0.44), rng.uniform(0.36, 0.55)
    case.add(box(width, depth, height - 0.08), palette.pick(palette.woods + palette.paints), (0, 0, 0.08))
    case.add(box(width * 0.9, depth * 0.8, 0.08), palette.dark)
    _doors(case, palette, width, depth, 0.1, height - 0.03, 3)
    screen = min(width * 0.8, rng.uniform(0.8, 1.3))
    case.add(box(0.3, 0.2, 0.015), palette.dark, (0, 0, height))
    case.add(box(0.05, 0.03, 0.1), palette.dark, (0, 0, height))
    case.add(box(screen, 0.035, screen * 0.57), palette.dark, (0, 0, height + 0.07))


def _shelf(shelf: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth, height = rng.uniform(0.6, 1.3), rng.uniform(0.26, 0.34), rng.uniform(1.1, 2.1)
    wood, boards = palette.pick(palette.woods + palette.paints), int(rng.integers(3, 6))
    shelf.add(box(width, 0.012, height), wood, (0, -depth / 2 + 0.006, 0))
    for side in (-1, 1):
        shelf.add(box(0.022, depth, height), wood, (side * (width / 2 - 0.011), 0, 0))
    levels = np.linspace(0.05, height - 0.022, boards + 1)
    for z in levels:
        shelf.add(box(width - 0.044, depth - 0.012, 0.022), wood, (0, 0.006, float(z)))
    covers = [palette.accent() for _ in range(6)]
    for low, high in zip(levels[:-1], levels[1:], strict=True):
        x, stop = -width / 2 + 0.04, -width / 2 + 0.04 + (width - 0.1) * rng.uniform(0.2, 1.0)
        while x < stop - 0.05:
            thick, tall = rng.uniform(0.02, 0.055), (high - low - 0.04) * rng.uniform(0.55, 0.95)
            shelf.add(box(thick - 0.002, rng.uniform(0.14, depth - 0.06), tall), palette.pick(covers),
                      (x + thick / 2, -0.02, float(low) + 0.022))  # fmt: skip
            x += thick


def _counter(counter: Assembly, palette: Palette, rng: Rng) -> None:
    """Build a row of kitchen units with sink and hob in the worktop."""
    width, depth, height = rng.uniform(1.6, 3.0), 0.6, rng.uniform(0.86, 0.92)
    counter.add(
        box(width, depth - 0.03, height - 0.14),
        palette.pick(palette.woods + palette.paints),
        (0, -0.01, 0.10),
    )
    counter.add(box(width, depth - 0.1, 0.10), palette.dark, (0, -0.04, 0))
    counter.add(box(width, depth, 0.04), palette.pick(palette.stones + palette.woods), (0, 0, height - 0.04))
    _doors(counter, palette, width, depth - 0.05, 0.12, height - 0.06, round(width / 0.6))
    counter.add(box(0.55, 0.5, 0.006), palette.dark, (-width / 4, 0, height))
    metal = palette.metals[0]
    counter.add(box(0.5, 0.42, 0.006), metal, (width / 4, 0, height))
    tap = [(width / 4, -0.22, height), (width / 4, -0.22, height + 0.28), (width / 4, -0.06, height + 0.26)]
    counter.add(tube(bent(tap, 0.06), 0.012, 6), metal)
    counter.surfaces.append(Surface(-0.12, -0.25, width / 4 - 0.28, 0.2, height))


def _wall_units(units: Assembly, palette: Palette, rng: Rng) -> None:
    width = rng.uniform(1.2, 2.0)
    units.add(box(width, 0.32, 0.65), palette.pick(palette.woods + palette.paints))
    _doors(units, palette, width, 0.32, 0.0, 0.65, round(width / 0.5))


def _fridge(fridge: Assembly, palette: Palette, rng: Rng) -> None:
    height, finish = rng.uniform(1.5, 1.95), palette.pick([*palette.metals, palette.white])
    fridge.add(box(0.6, 0.6, height), finish)
    for low, high in ((0.05, height * 0.35), (height * 0.36, height - 0.01)):
        _doors(fridge, palette, 0.6, 0.6, low, high, 1)


def _bath(bath: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth = rng.uniform(1.5, 1.7), rng.uniform(0.68, 0.78)
    outer, inner = rounded(width, depth, 0.08), rounded(width - 0.12, depth - 0.12, 0.2)
    bath.add(prism(outer, 0, 0.52), palette.white)
    bath.add(prism(inner, 0.52, 0.523), palette.metals[0])


def _toilet(toilet: Assembly, palette: Palette, rng: Rng) -> None:
    toilet.add(box(0.38, 0.16, 0.42), palette.white, (0, -0.26, 0.36))
    toilet.add(prism(rounded(0.36, 0.52, 0.17, 6), 0.28, 0.42), palette.white, (0, 0.06, 0))
    toilet.add(box(0.2, 0.45, 0.3), palette.white, (0, -0.08, 0))


def _basin(basin: Assembly, palette: Palette, rng: Rng) -> None:
    width = rng.uniform(0.5, 0.9)
    basin.add(box(width * 0.95, 0.42, 0.6), palette.pick(palette.woods + palette.paints), (0, -0.02, 0.2))
    basin.add(cushion(width, 0.48, 0.12, 0.04), palette.white, (0, 0, 0.78))
    basin.add(box(width * 0.8, 0.015, 0.7), palette.metals[0], (0, -0.23, 1.15))


STORAGE: Mapping[str, Callable[[Assembly, Palette, Rng], None]] = {
    "wardrobe": _wardrobe,
    "dresser": _dresser,
    "nightstand": _nightstand,
    "sideboard": _sideboard,
    "tv_stand": _tv_stand,
    "shelf": _shelf,
    "kitchen_counter": _counter,
    "wall_units": _wall_units,
    "fridge": _fridge,
    "bath": _bath,
    "toilet": _toilet,
    "basin": _basin,
}

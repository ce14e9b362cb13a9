"""Everything in a home that is neither chair, table nor bed; backs are at -y, fronts at +y."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.procedural.pieces import Assembly, Piece, Surface
from imagination.scenes.procedural.shapes import bent, box, cushion, lathe, prism, rounded, sheet, tube
from imagination.scenes.procedural.textures import Palette, painting, rug, stripes

Rng = np.random.Generator


def _sofa(sofa: Assembly, palette: Palette, rng: Rng) -> None:
    cloth = palette.pick(palette.fabrics + palette.leathers)
    count, place, arm = int(rng.integers(2, 4)), rng.uniform(0.58, 0.72), rng.uniform(0.10, 0.22)
    seat, depth, lift, rear = rng.uniform(0.38, 0.46), rng.uniform(0.52, 0.62), rng.uniform(0.04, 0.14), 0.18
    inner, back = count * place, rng.uniform(0.32, 0.48)
    whole, deep = inner + 2 * arm, depth + rear
    legs = palette.pick(palette.woods + palette.metals)
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        sofa.add(box(0.05, 0.05, lift + 0.01), legs, (sx * (whole / 2 - 0.08), sy * (deep / 2 - 0.08), 0))
    sofa.add(cushion(whole, deep, seat - 0.13 - lift, 0.03), cloth, (0, 0, lift))
    sofa.add(cushion(whole, rear * 0.8, seat + back - 0.05 - lift, 0.05), cloth, (0, -deep / 2 + rear * 0.4, lift))
    for number in range(count):
        x = (number - (count - 1) / 2) * place
        sofa.add(cushion(place - 0.01, depth, 0.15, 0.05, 0.02), cloth, (x, rear / 2, seat - 0.14))
        at = (x, -deep / 2 + rear * 0.8 + 0.09, seat)
        sofa.add(cushion(place - 0.02, 0.16, back, 0.06, 0.02), cloth, at, tilt=0.18)
    for side in (-1, 1):
        x = side * (whole - arm) / 2
        sofa.add(cushion(arm, deep, seat + rng.uniform(0.14, 0.2) - lift, 0.045), cloth, (x, 0, lift))
        if rng.random() < 0.5:
            at = (side * (inner / 2 - 0.2), -deep / 2 + rear + 0.2, seat + 0.02)
            sofa.add(cushion(0.40, 0.13, 0.38, 0.06), palette.pick(palette.fabrics), at, side * 0.4, 0.3)


def _stool(stool: Assembly, palette: Palette, rng: Rng) -> None:
    height, across = rng.choice([0.45, 0.66]) + rng.uniform(-0.02, 0.04), rng.uniform(0.30, 0.38)
    wood = palette.pick(palette.woods + palette.metals)
    top = palette.pick([wood, *palette.fabrics])
    stool.add(lathe([(across / 2 - 0.01, height - 0.04), (across / 2, height - 0.02), (across / 2 - 0.01, height)], 20), top)
    for angle in np.arange(4) * np.pi / 2 + np.pi / 4:
        direction = np.array([np.cos(angle), np.sin(angle)]) * across
        stool.add(tube([(*(direction * 0.5), 0.0), (*(direction * 0.36), height - 0.03)], 0.015, 6), wood)


def _pouf(pouf: Assembly, palette: Palette, rng: Rng) -> None:
    height, across = rng.uniform(0.32, 0.44), rng.uniform(0.42, 0.62)
    if rng.random() < 0.5:
        profile = [(across * 0.4, 0), (across * 0.5, 0.06), (across * 0.5, height - 0.06), (across * 0.4, height)]
        pouf.add(lathe(profile, 20), palette.pick(palette.fabrics))
    else:
        pouf.add(cushion(across, across, height, 0.05, 0.02), palette.pick(palette.fabrics + palette.leathers))


def _bench(bench: Assembly, palette: Palette, rng: Rng) -> None:
    wood, width = palette.pick(palette.woods), rng.uniform(0.85, 1.3)
    bench.add(cushion(width, 0.36, 0.09, 0.03), palette.pick([wood, *palette.fabrics]), (0, 0, 0.36))
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        bench.add(box(0.045, 0.045, 0.37), wood, (sx * (width / 2 - 0.04), sy * 0.14, 0))


def _doors(case: Assembly, palette: Palette, width: float, depth: float, low: float, high: float, count: int) -> None:
    """Doors or drawer fronts with handles on the front of a case."""
    finish, metal = case.parts[0][1], palette.pick(palette.metals)
    step = width / count
    for number in range(count):
        x = (number - (count - 1) / 2) * step
        case.add(box(step - 0.012, 0.018, high - low - 0.012), finish, (x, depth / 2 + 0.009, low + 0.006))
        side = step * (0.4 if number % 2 == 0 else -0.4)
        case.add(box(0.014, 0.025, min(0.2, (high - low) * 0.3)), metal, (x + side, depth / 2 + 0.027, (low + high) / 2))


def _wardrobe(case: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth, height = rng.uniform(0.9, 2.0), rng.uniform(0.52, 0.62), rng.uniform(1.85, 2.25)
    case.add(box(width, depth, height), palette.pick(palette.woods + palette.paints))
    _doors(case, palette, width, depth, 0.07, height - 0.02, max(2, round(width / 0.5)))


def _drawers(case: Assembly, wood: int, palette: Palette, width: float, depth: float, height: float, rows: int) -> None:
    """A chest of `rows` drawers."""
    case.add(box(width, depth, height - 0.06), palette.woods[wood % len(palette.woods)], (0, 0, 0.06))
    case.add(box(width * 0.9, depth * 0.9, 0.06), palette.dark)
    step = (height - 0.1) / rows
    for row in range(rows):
        _doors(case, palette, width - 0.02, depth, 0.08 + row * step, 0.08 + (row + 1) * step, 2 if width > 0.9 else 1)
    case.surfaces.append(Surface(-width / 2 + 0.03, -depth / 2 + 0.03, width / 2 - 0.03, depth / 2 - 0.03, height))


def _dresser(case: Assembly, palette: Palette, rng: Rng) -> None:
    _drawers(case, int(rng.integers(9)), palette, rng.uniform(0.75, 1.5), rng.uniform(0.4, 0.5), rng.uniform(0.75, 1.1), 3)


def _nightstand(case: Assembly, palette: Palette, rng: Rng) -> None:
    _drawers(case, 0, palette, rng.uniform(0.38, 0.52), rng.uniform(0.34, 0.42), rng.uniform(0.42, 0.6), 2)


def _sideboard(case: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth, height = rng.uniform(1.1, 1.8), rng.uniform(0.38, 0.48), rng.uniform(0.72, 0.95)
    lift = rng.uniform(0.06, 0.18)
    case.add(box(width, depth, height - lift), palette.pick(palette.woods), (0, 0, lift))
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        case.add(box(0.04, 0.04, lift), palette.dark, (sx * (width / 2 - 0.06), sy * (depth / 2 - 0.06), 0))
    _doors(case, palette, width, depth, lift + 0.02, height - 0.03, round(width / 0.45))
    case.surfaces.append(Surface(-width / 2 + 0.05, -depth / 2 + 0.05, width / 2 - 0.05, depth / 2 - 0.05, height))


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


def _floor_lamp(lamp: Assembly, palette: Palette, rng: Rng) -> None:
    metal, height, shade = palette.pick(palette.metals), rng.uniform(1.35, 1.75), rng.uniform(0.14, 0.24)
    lamp.add(lathe([(0.15, 0), (0.15, 0.02), (0.02, 0.035), (0.012, 0.06), (0.012, height - 0.1)], 16), metal)
    lamp.add(lathe([(shade, height - 0.15), (shade * rng.uniform(0.5, 0.95), height + 0.12)], 18), palette.pick(palette.linens))


def _table_lamp(lamp: Assembly, palette: Palette, rng: Rng) -> None:
    height, bulge, shade = rng.uniform(0.18, 0.3), rng.uniform(0.03, 0.07), rng.uniform(0.09, 0.14)
    foot = [(0.06, 0), (0.06, 0.015), (bulge, height * 0.3), (0.015, height * 0.8), (0.01, height)]
    lamp.add(lathe(foot, 14), palette.pick(palette.metals + palette.plastics))
    lamp.add(lathe([(shade, height - 0.02), (shade * 0.7, height + 0.16)], 16), palette.pick(palette.linens))


def _plant(plant: Assembly, palette: Palette, rng: Rng) -> None:
    across, pot, height = rng.uniform(0.2, 0.36), rng.uniform(0.18, 0.36), rng.uniform(0.6, 1.5)
    profile = [(across * 0.36, 0), (across * 0.5, pot), (across * 0.44, pot), (across * 0.42, pot - 0.03)]
    plant.add(lathe(profile, 16), palette.pick(palette.plastics + palette.paints))
    spread, leaves = rng.uniform(0.16, 0.32), int(rng.integers(10, 18))
    for number in range(leaves):
        angle, reach = number * 2.4 + rng.uniform(-0.3, 0.3), spread * rng.uniform(0.5, 1.0)
        top, share = pot + (height - pot) * rng.uniform(0.45, 1.0), np.linspace(0, 1, 5)
        out, up = reach * share**1.6, pot - 0.04 + (top - pot) * np.sin(share * np.pi * 0.62)
        half = 0.05 * np.sin(np.pi * (0.12 + 0.86 * share))
        points = np.stack([np.stack([out, side * half, up], axis=-1) for side in (-1, 0, 1)], axis=1)
        plant.add(sheet(points, 0.004), palette.leaves, yaw=float(angle))


def _rug(piece: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth = rng.uniform(1.5, 2.5), rng.uniform(1.1, 1.8)
    pattern = rug if rng.random() < 0.6 else stripes
    piece.add(box(width, depth, 0.008), palette.one(pattern, (0.9, 0.85, 0.8), width))


def _picture(picture: Assembly, palette: Palette, rng: Rng) -> None:
    width, height = rng.uniform(0.3, 0.95), rng.uniform(0.3, 0.75)
    picture.add(box(width, 0.02, height), palette.pick(palette.woods + palette.metals))
    image = palette.one(painting, (1.0, 1.0, 1.0), max(width, height))
    picture.add(box(width - 0.06, 0.004, height - 0.06), image, (0, 0.011, 0.03))


def _counter(counter: Assembly, palette: Palette, rng: Rng) -> None:
    """A run of kitchen units; sink and hob are set into the worktop."""
    width, depth, height = rng.uniform(1.6, 3.0), 0.6, rng.uniform(0.86, 0.92)
    counter.add(box(width, depth - 0.03, height - 0.14), palette.pick(palette.woods + palette.paints), (0, -0.01, 0.10))
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


def _books(books: Assembly, palette: Palette, rng: Rng) -> None:
    z = 0.0
    for _ in range(int(rng.integers(1, 5))):
        thick = rng.uniform(0.012, 0.035)
        size = rng.uniform(0.15, 0.22), rng.uniform(0.2, 0.28)
        books.add(box(*size, thick), palette.accent(), (0, 0, z), float(rng.normal(0, 0.15)))
        z += thick


def _vase(vase: Assembly, palette: Palette, rng: Rng) -> None:
    height, belly = rng.uniform(0.14, 0.32), rng.uniform(0.04, 0.09)
    profile = [(belly * 0.6, 0), (belly, height * 0.35), (belly * 0.4, height * 0.8), (belly * 0.55, height)]
    vase.add(lathe(profile, 16), palette.accent())


def _bowl(bowl: Assembly, palette: Palette, rng: Rng) -> None:
    across = rng.uniform(0.1, 0.17)
    bowl.add(lathe([(across * 0.4, 0), (across, 0.07), (across * 0.9, 0.07), (across * 0.3, 0.02)], 18), palette.accent())


def _monitor(monitor: Assembly, palette: Palette, rng: Rng) -> None:
    width = rng.uniform(0.45, 0.68)
    monitor.add(box(0.24, 0.18, 0.012), palette.dark)
    monitor.add(box(0.04, 0.025, 0.2), palette.dark, (0, -0.03, 0))
    monitor.add(box(width, 0.03, width * 0.58), palette.dark, (0, 0, 0.1))
    monitor.add(box(0.42, 0.13, 0.02), palette.pick([palette.dark, palette.white]), (0, 0.22, 0))


def _carton(carton: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth, height = rng.uniform(0.25, 0.5, 3)
    carton.add(box(width, depth, height), palette.one(None, (0.68, 0.52, 0.36), 1.0))
    carton.add(box(width * 1.001, 0.06, 0.004), palette.one(None, (0.8, 0.7, 0.5), 1.0), (0, 0, height))


def _basket(basket: Assembly, palette: Palette, rng: Rng) -> None:
    across, height = rng.uniform(0.28, 0.42), rng.uniform(0.26, 0.5)
    profile = [(across * 0.42, 0), (across * 0.5, height), (across * 0.46, height), (across * 0.4, 0.1)]
    basket.add(lathe(profile, 18), palette.pick(palette.fabrics + palette.woods))


BUILDERS: Mapping[str, Callable[[Assembly, Palette, Rng], None]] = {
    "sofa": _sofa, "stool": _stool, "pouf": _pouf, "bench": _bench, "wardrobe": _wardrobe, "dresser": _dresser,
    "nightstand": _nightstand, "sideboard": _sideboard, "tv_stand": _tv_stand, "shelf": _shelf, "floor_lamp": _floor_lamp,
    "table_lamp": _table_lamp, "plant": _plant, "rug": _rug, "picture": _picture, "kitchen_counter": _counter,
    "wall_units": _wall_units, "fridge": _fridge, "bath": _bath, "toilet": _toilet, "basin": _basin, "books": _books,
    "vase": _vase, "bowl": _bowl, "monitor": _monitor, "carton": _carton, "basket": _basket,
}  # fmt: skip


def build_distractor(label: str, palette: Palette, rng: Rng) -> Piece:
    """A thing of random shape, by its label."""
    piece = Assembly(label, label)
    BUILDERS[label](piece, palette, rng)
    return piece.finished()

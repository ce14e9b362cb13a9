"""Distractors: objects that are neither chairs, tables, beds nor storage; the front is at +y."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import Assembly, Piece
from imagination.scenes.building_blocks.shapes import box, cushion, lathe, sheet, tube
from imagination.scenes.building_blocks.textures import painting, rug, stripes
from imagination.scenes.procedural.furniture.storage import STORAGE

Rng = np.random.Generator


def _sofa(sofa: Assembly, palette: Palette, rng: Rng) -> None:
    cloth = palette.pick(palette.fabrics + palette.leathers)
    count, seat_width, arm = int(rng.integers(2, 4)), rng.uniform(0.58, 0.72), rng.uniform(0.10, 0.22)
    seat, depth, lift, rear = rng.uniform(0.38, 0.46), rng.uniform(0.52, 0.62), rng.uniform(0.04, 0.14), 0.18
    inner, back = count * seat_width, rng.uniform(0.32, 0.48)
    whole, deep = inner + 2 * arm, depth + rear
    legs = palette.pick(palette.woods + palette.metals)
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        sofa.add(box(0.05, 0.05, lift + 0.01), legs, (sx * (whole / 2 - 0.08), sy * (deep / 2 - 0.08), 0))
    sofa.add(cushion(whole, deep, seat - 0.13 - lift, 0.03), cloth, (0, 0, lift))
    sofa.add(
        cushion(whole, rear * 0.8, seat + back - 0.05 - lift, 0.05), cloth, (0, -deep / 2 + rear * 0.4, lift)
    )
    for number in range(count):
        x = (number - (count - 1) / 2) * seat_width
        sofa.add(cushion(seat_width - 0.01, depth, 0.15, 0.05, 0.02), cloth, (x, rear / 2, seat - 0.14))
        at = (x, -deep / 2 + rear * 0.8 + 0.09, seat)
        sofa.add(cushion(seat_width - 0.02, 0.16, back, 0.06, 0.02), cloth, at, tilt=0.18)
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
    stool.add(
        lathe(
            [(across / 2 - 0.01, height - 0.04), (across / 2, height - 0.02), (across / 2 - 0.01, height)], 20
        ),
        top,
    )
    for angle in np.arange(4) * np.pi / 2 + np.pi / 4:
        direction = np.array([np.cos(angle), np.sin(angle)]) * across
        stool.add(tube([(*(direction * 0.5), 0.0), (*(direction * 0.36), height - 0.03)], 0.015, 6), wood)


def _pouf(pouf: Assembly, palette: Palette, rng: Rng) -> None:
    height, across = rng.uniform(0.32, 0.44), rng.uniform(0.42, 0.62)
    if rng.random() < 0.5:
        profile = [
            (across * 0.4, 0),
            (across * 0.5, 0.06),
            (across * 0.5, height - 0.06),
            (across * 0.4, height),
        ]
        pouf.add(lathe(profile, 20), palette.pick(palette.fabrics))
    else:
        pouf.add(
            cushion(across, across, height, 0.05, 0.02), palette.pick(palette.fabrics + palette.leathers)
        )


def _bench(bench: Assembly, palette: Palette, rng: Rng) -> None:
    wood, width = palette.pick(palette.woods), rng.uniform(0.85, 1.3)
    bench.add(cushion(width, 0.36, 0.09, 0.03), palette.pick([wood, *palette.fabrics]), (0, 0, 0.36))
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        bench.add(box(0.045, 0.045, 0.37), wood, (sx * (width / 2 - 0.04), sy * 0.14, 0))


def _floor_lamp(lamp: Assembly, palette: Palette, rng: Rng) -> None:
    metal, height, shade = palette.pick(palette.metals), rng.uniform(1.35, 1.75), rng.uniform(0.14, 0.24)
    lamp.add(lathe([(0.15, 0), (0.15, 0.02), (0.02, 0.035), (0.012, 0.06), (0.012, height - 0.1)], 16), metal)
    lamp.add(
        lathe([(shade, height - 0.15), (shade * rng.uniform(0.5, 0.95), height + 0.12)], 18),
        palette.pick(palette.linens),
    )


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
        top, t = pot + (height - pot) * rng.uniform(0.45, 1.0), np.linspace(0, 1, 5)
        out, up = reach * t**1.6, pot - 0.04 + (top - pot) * np.sin(t * np.pi * 0.62)
        half = 0.05 * np.sin(np.pi * (0.12 + 0.86 * t))
        points = np.stack([np.stack([out, side * half, up], axis=-1) for side in (-1, 0, 1)], axis=1)
        plant.add(sheet(points, 0.004), palette.leaves, yaw=float(angle))


def _rug(piece: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth = rng.uniform(1.5, 2.5), rng.uniform(1.1, 1.8)
    pattern = rug if rng.random() < 0.6 else stripes
    piece.add(box(width, depth, 0.008), palette.new_finish(pattern, (0.9, 0.85, 0.8), 1.0), whole=True)


def _picture(picture: Assembly, palette: Palette, rng: Rng) -> None:
    width, height = rng.uniform(0.3, 0.95), rng.uniform(0.3, 0.75)
    picture.add(box(width, 0.02, height), palette.pick(palette.woods + palette.metals))
    image = palette.new_finish(painting, (1.0, 1.0, 1.0), 1.0)
    picture.add(box(width - 0.06, 0.004, height - 0.06), image, (0, 0.011, 0.03), whole=True)


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
    bowl.add(
        lathe([(across * 0.4, 0), (across, 0.07), (across * 0.9, 0.07), (across * 0.3, 0.02)], 18),
        palette.accent(),
    )


def _monitor(monitor: Assembly, palette: Palette, rng: Rng) -> None:
    width = rng.uniform(0.45, 0.68)
    monitor.add(box(0.24, 0.18, 0.012), palette.dark)
    monitor.add(box(0.04, 0.025, 0.2), palette.dark, (0, -0.03, 0))
    monitor.add(box(width, 0.03, width * 0.58), palette.dark, (0, 0, 0.1))
    monitor.add(box(0.42, 0.13, 0.02), palette.pick([palette.dark, palette.white]), (0, 0.22, 0))


def _carton(carton: Assembly, palette: Palette, rng: Rng) -> None:
    width, depth, height = rng.uniform(0.25, 0.5, 3)
    carton.add(box(width, depth, height), palette.new_finish(None, (0.68, 0.52, 0.36), 1.0))
    carton.add(
        box(width * 1.001, 0.06, 0.004), palette.new_finish(None, (0.8, 0.7, 0.5), 1.0), (0, 0, height)
    )


def _basket(basket: Assembly, palette: Palette, rng: Rng) -> None:
    across, height = rng.uniform(0.28, 0.42), rng.uniform(0.26, 0.5)
    profile = [(across * 0.42, 0), (across * 0.5, height), (across * 0.46, height), (across * 0.4, 0.1)]
    basket.add(lathe(profile, 18), palette.pick(palette.fabrics + palette.woods))


BUILDERS: Mapping[str, Callable[[Assembly, Palette, Rng], None]] = {
    **STORAGE,
    "sofa": _sofa,
    "stool": _stool,
    "pouf": _pouf,
    "bench": _bench,
    "floor_lamp": _floor_lamp,
    "table_lamp": _table_lamp,
    "plant": _plant,
    "rug": _rug,
    "picture": _picture,
    "books": _books,
    "vase": _vase,
    "bowl": _bowl,
    "monitor": _monitor,
    "carton": _carton,
    "basket": _basket,
}


def build_distractor(label: str, palette: Palette, rng: Rng) -> Piece:
    """Build an object of a label with a random shape."""
    piece = Assembly(label, label)
    BUILDERS[label](piece, palette, rng)
    return piece.finished()

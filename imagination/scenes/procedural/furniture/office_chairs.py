"""Office chairs on a five-star base, which face +y."""

import numpy as np

from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import Assembly, Piece
from imagination.scenes.building_blocks.shapes import box, cushion, lathe, tube
from imagination.scenes.procedural.furniture.chair_parts import bowl
from imagination.scenes.procedural.furniture.styles import Style


def _star(chair: Assembly, style: Style, palette: Palette) -> None:
    """Add a five-star base with castors and a gas spring."""
    metal = palette.pick([*palette.metals, palette.dark])
    reach, turn = style["star"], 0.3
    for number in range(5):
        angle = turn + number * 2 * np.pi / 5
        tip = (reach * np.cos(angle), reach * np.sin(angle))
        chair.add(tube([(0, 0, 0.10), (*tip, 0.07)], [0.032, 0.018], 4), metal)
        chair.add(cushion(0.045, 0.045, 0.06, 0.02, steps=1), palette.dark, (*tip, 0), yaw=angle)
    seat = style["seat"]
    spring = [(0.03, 0.08), (0.03, seat * 0.6), (0.018, seat * 0.6), (0.018, seat - 0.05)]
    chair.add(lathe(spring, 12), palette.dark)
    chair.add(
        box(style["width"] * 0.4, style["depth"] * 0.5, 0.03), palette.dark, (0, 0, style["seat"] - 0.08)
    )


def build_office_chair(style: Style, palette: Palette) -> Piece:
    """Build an office chair of one style with finishes of the palette."""
    chair = Assembly(style.family.label, style.model)
    cloth = palette.pick(palette.fabrics[:3] + palette.leathers + [palette.dark])
    width, depth, seat, back = style["width"], style["depth"], style["seat"], style["back"]
    _star(chair, style, palette)
    kind = style.family.name
    if kind == "bucket_swivel":
        bowl(chair, style, cloth)
        return chair.finished()
    chair.add(cushion(width, depth, 0.08, 0.035, 0.015), cloth, (0, 0, seat - 0.07))
    at, rake = (0.0, -depth / 2 - 0.01, seat), style["rake"]
    if kind == "executive_swivel":
        chair.add(
            cushion(width * 0.96, style["pad"], back, 0.04), cloth, (0, -depth / 2 + 0.02, seat), tilt=rake
        )
        chair.add(cushion(width * 0.7, 0.04, back * 0.3, 0.018).moved((0, style["pad"] / 2, back * 0.66)), cloth,
                  (0, -depth / 2 + 0.02, seat), tilt=rake)  # fmt: skip
    else:
        low = style["gap"]
        chair.add(box(0.07, 0.02, low + back * 0.4).moved((0, -0.02, -0.05)), palette.dark, at, tilt=rake)
        chair.add(cushion(width * 0.9, 0.05, back - low, 0.022).moved((0, 0.01, low)), cloth, at, tilt=rake)
    if kind == "headrest_swivel":
        chair.add(box(0.05, 0.02, 0.16).moved((0, 0, back - 0.05)), palette.dark, at, tilt=rake)
        chair.add(
            cushion(width * 0.55, 0.06, 0.14, 0.028).moved((0, 0.02, back + 0.08)), cloth, at, tilt=rake
        )
    if "armrests" in style:
        for side in (-1, 1):
            x = side * (width / 2 + 0.03)
            chair.add(box(0.03, 0.06, 0.24), palette.dark, (x, -0.02, seat - 0.05))
            chair.add(cushion(0.07, depth * 0.55, 0.035, 0.016, steps=1), palette.dark, (x, 0, seat + 0.18))
            chair.add(box(width * 0.25, 0.05, 0.02), palette.dark, (side * width * 0.42, -0.02, seat - 0.05))
    return chair.finished()

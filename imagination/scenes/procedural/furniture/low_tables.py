"""Coffee tables and side tables."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import Assembly, Piece
from imagination.scenes.building_blocks.shapes import bent, box, ellipse, lathe, prism, rectangle, tube
from imagination.scenes.procedural.furniture.dining_tables import CORNERS, around, square_legs
from imagination.scenes.procedural.furniture.styles import Style


def _low(table: Assembly, style: Style, palette: Palette) -> None:
    """Build a coffee table with a rectangular or oval top."""
    top = palette.pick(palette.woods + palette.stones)
    length, depth, height = style["length"], style["depth"], style["height"]
    leg, under, kind = style["leg"], style["height"] - style["thick"], style.family.name
    outline = ellipse(length, depth) if "oval" in style else rectangle(length, depth)
    table.add(prism(outline, under, height), top)
    if kind == "block_table":
        for side in (-1, 1):
            table.add(box(leg, depth, under), top, (side * (length - leg) / 2, 0, 0))
        table.add(box(length - 2 * leg, depth * 0.9, 0.02), top, (0, 0, under * 0.35))
    elif kind == "hairpin_table":
        metal, radius = palette.pick(palette.metals), leg / 2 + 0.002
        for sx, sy in CORNERS:
            x, y = sx * length * 0.34, sy * depth * 0.34
            pin = [(x - 0.06, y, under), (x * 1.1, y * 1.1, radius), (x, y + 0.06 * sy, under)]
            table.add(tube(bent(pin, 0.03), radius, 6), metal)
    else:
        legs = palette.pick([top, *palette.metals, *palette.woods])
        square_legs(table, legs, length - 0.02, depth - 0.02, leg, under)
        if "shelf" in style:
            table.add(box(length - 0.04, depth - 0.04, 0.018), legs, (0, 0, height * 0.3))
    table.surfaces.append(around(length * 0.36, depth * 0.36, height))


def _small_round(table: Assembly, style: Style, palette: Palette) -> None:
    """Build a round coffee table, a side table on one stem, or a drum."""
    top = palette.pick(palette.woods + palette.stones + palette.metals)
    across, height, kind = style["across"], style["height"], style.family.name
    if kind == "drum":
        waist = style["waist"] * across / 2
        table.add(lathe([(across / 2, 0), (waist, height * 0.5), (across / 2, height)], 24), top)
    else:
        thick = style["thick"]
        table.add(prism(ellipse(across, across, 28), height - thick, height), top)
        base = palette.pick([*palette.metals, *palette.woods])
        if kind == "stand":
            stem, foot = style["stem"], across * 0.36
            table.add(lathe([(foot, 0), (foot, 0.015), (stem, 0.03), (stem, height - thick)], 20), base)
        else:
            reach, splay, leg = across * 0.30, style["splay"], style["leg"]
            for angle in np.arange(3) * 2 * np.pi / 3 + 0.4:
                direction = np.array([np.cos(angle), np.sin(angle)])
                foot_at, top_at = (
                    (*(direction * (reach + splay)), 0.0),
                    (*(direction * reach), height - thick),
                )
                table.add(tube([foot_at, top_at], [leg * 0.35, leg * 0.5], 8), base)
            if "shelf" in style:
                table.add(
                    prism(ellipse(across * 0.7, across * 0.7, 24), 0, 0.015), top, (0, 0, height * 0.35)
                )
    table.surfaces.append(around(across * 0.32, across * 0.32, height))


def _square_side(table: Assembly, style: Style, palette: Palette) -> None:
    """Build a square side table."""
    wood, across, height, thick = (
        palette.pick(palette.woods),
        style["across"],
        style["height"],
        style["thick"],
    )
    table.add(box(across, across, thick), wood, (0, 0, height - thick))
    square_legs(
        table,
        palette.pick([wood, *palette.metals]),
        across - 0.02,
        across - 0.02,
        style["leg"],
        height - thick,
    )
    if "shelf" in style:
        table.add(box(across - 0.04, across - 0.04, 0.015), wood, (0, 0, height * 0.3))
    table.surfaces.append(around(across * 0.42, across * 0.42, height))


BUILDERS: Mapping[str, Callable[[Assembly, Style, Palette], None]] = {
    **dict.fromkeys(("low_table", "block_table", "hairpin_table"), _low),
    **dict.fromkeys(("round_coffee_table", "stand", "drum"), _small_round),
    "square_side_table": _square_side,
}


def build_low_table(style: Style, palette: Palette) -> Piece:
    """Build a coffee table or side table of one style with finishes of the palette."""
    table = Assembly(style.family.label, style.model)
    BUILDERS[style.family.name](table, style, palette)
    return table.finished()

"""Dining tables with their seats."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.building_blocks.palette import Finish, Palette
from imagination.scenes.building_blocks.pieces import Assembly, Piece, Seat, Surface
from imagination.scenes.building_blocks.shapes import box, ellipse, lathe, prism, rectangle, rounded, tube
from imagination.scenes.procedural.furniture.styles import Style

CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
SEAT_WIDTH = 0.58
"""Length of table edge for one seat, metres."""


def around(half_x: float, half_y: float, height: float) -> Surface:
    """Return a surface centred on the table."""
    return Surface(-half_x, -half_y, half_x, half_y, height)


def _rectangular_seats(
    length: float, depth: float, reach: float, ends: float, legs: float, underside: float
) -> list[Seat]:
    """Return the seats along both long sides and at the ends.

    Args:
        length, depth: size of the top, metres.
        reach: maximum depth of chairs under the long sides, metres.
        ends: maximum depth of chairs under the ends, metres; 0 for no seats there.
        legs: total length of the long side that legs occupy, metres.
        underside: height of the lowest part above the chairs, metres.
    """
    seats = []
    free = length - legs
    count = max(1, int(free / SEAT_WIDTH))
    for x in (np.arange(count) - (count - 1) / 2) * free / count:
        for side in (-1.0, 1.0):
            yaw = np.pi if side > 0 else 0.0
            seats.append(
                Seat(float(x), side * depth / 2, yaw, free / count, min(reach, depth / 2 - 0.03), underside)
            )
    if ends > 0 and depth > 0.7:
        for side in (-1.0, 1.0):
            yaw = np.pi / 2 if side > 0 else -np.pi / 2
            seats.append(Seat(side * length / 2, 0.0, yaw, depth - 0.15, ends, underside))
    return seats


def _round_seats(width: float, depth: float, reach: float, underside: float) -> list[Seat]:
    """Return seats around an ellipse that face its centre."""
    count = int(np.clip(np.pi * (width + depth) / 2 / 0.78, 2, 8))
    seats = []
    for angle in np.arange(count) * 2 * np.pi / count:
        x, y = width / 2 * np.cos(angle), depth / 2 * np.sin(angle)
        inward = np.arctan2(-y, -x)
        seats.append(Seat(float(x), float(y), float(inward - np.pi / 2), 0.62, reach, underside))
    return seats


def square_legs(table: Assembly, finish: Finish, length: float, depth: float, leg: float, top: float) -> None:
    """Add four square legs flush with the corners of a rectangle."""
    for sx, sy in CORNERS:
        table.add(box(leg, leg, top), finish, (sx * (length - leg) / 2, sy * (depth - leg) / 2, 0))


def _rectangular(table: Assembly, style: Style, palette: Palette) -> None:
    """Build a dining table with a rectangular top on legs, trestles or panels."""
    wood = palette.pick(palette.woods)
    base = palette.pick([wood, wood, *palette.woods, *palette.metals, *palette.paints[:1]])
    length, depth, height, thick = style["length"], style["depth"], style["height"], style["thick"]
    under, kind = height - thick, style.family.name
    outline = rounded(length, depth, 0.08) if "round_corners" in style else rectangle(length, depth)
    table.add(prism(outline, under, height), wood)
    table.surfaces.append(around(length / 2, depth / 2, height))
    if kind == "four_leg_table":
        leg, apron = style["leg"], style["apron"]
        square_legs(table, base, length - 0.03, depth - 0.03, leg, under)
        for side in (-1, 1):
            table.add(
                box(length - 2 * leg - 0.03, 0.022, apron),
                base,
                (0, side * (depth / 2 - 0.04), under - apron),
            )
            table.add(
                box(0.022, depth - 2 * leg - 0.03, apron),
                base,
                (side * (length / 2 - 0.04), 0, under - apron),
            )
        table.seats = _rectangular_seats(length, depth, depth / 2, 0.30, 2 * leg + 0.06, under - apron)
        return
    leg, inset = style["leg"], min(style["inset"], length / 2 - 0.35)
    for side in (-1, 1):
        x = side * (length / 2 - inset - leg / 2)
        if kind == "panel_table":
            table.add(box(leg, depth * 0.92, under), base, (x, 0, 0))
        elif kind == "trestle_table":
            table.add(box(leg, depth * 0.8, 0.06), base, (x, 0, 0))
            table.add(box(leg * 0.9, 0.16, under - 0.12), base, (x, 0, 0.06))
            table.add(box(leg, depth * 0.75, 0.06), base, (x, 0, under - 0.06))
        else:
            for lean in (-1, 1):
                foot, top = (x, lean * depth * 0.42, 0.0), (x, -lean * depth * 0.42, under)
                table.add(tube([foot, top], leg * 0.7, 4), base)
    bar = length - 2 * inset - leg
    if kind == "trestle_table":
        table.add(box(bar, 0.04, 0.10), base, (0, 0, 0.25))
    elif kind == "x_table":
        table.add(box(bar, 0.05, 0.05), base, (0, 0, under / 2 - 0.025))
    else:
        table.add(box(bar, 0.025, 0.09), base, (0, 0, under - 0.09))
    reach = depth / 2 - (0.06 if kind == "trestle_table" else 0.03)
    table.seats = _rectangular_seats(
        length, depth, reach, max(0.0, inset - 0.02), 2 * (inset + leg) + 0.04, under - 0.06
    )


def _boat(table: Assembly, style: Style, palette: Palette) -> None:
    """Build a long table with bowed sides on two columns."""
    wood = palette.pick(palette.woods)
    length, depth, height, thick = style["length"] + 0.25, style["depth"], style["height"], style["thick"]
    along = np.linspace(-0.5, 0.5, 13)
    bow = depth / 2 * (1 - 0.9 * along**2)
    outline = np.concatenate([np.column_stack([along, -bow]), np.column_stack([along[::-1], bow[::-1]])]) * [
        length,
        1.0,
    ]
    table.add(prism(outline, height - thick, height), wood)
    stem, foot = style["stem"], min(style["foot"], depth * 0.75)
    column = [(stem, 0.05), (stem * 0.6, 0.25), (stem, 0.45), (stem * 0.7, height - thick)]
    for side in (-1, 1):
        x = side * length * 0.27
        table.add(lathe(column, 16), wood, (x, 0, 0))
        table.add(box(0.09, foot, 0.06), wood, (x, 0, 0))
        table.add(box(0.09, foot * 0.8, 0.04), wood, (x, 0, height - thick - 0.04))
    table.surfaces.append(around(length / 2.2, depth / 2.6, height))
    table.seats = _rectangular_seats(length, depth * 0.9, 0.22, 0.30, length * 0.2, height - thick - 0.04)


def _round(table: Assembly, style: Style, palette: Palette) -> None:
    """Build a round dining table on four legs."""
    wood = palette.pick(palette.woods)
    across, height, thick, leg = style["across"], style["height"], style["thick"], style["leg"]
    table.add(prism(ellipse(across, across), height - thick, height), wood)
    base = palette.pick([wood, *palette.woods, *palette.metals])
    reach = (across / 2 - style["inset"]) * np.sqrt(0.5)
    for sx, sy in CORNERS:
        foot = (sx * reach * 1.12, sy * reach * 1.12, 0.0)
        table.add(tube([foot, (sx * reach, sy * reach, height - thick)], [leg * 0.4, leg * 0.6], 8), base)
    for side in (-1, 1):
        table.add(box(2 * reach, 0.022, 0.06), base, (0, side * reach, height - thick - 0.06))
        table.add(box(0.022, 2 * reach, 0.06), base, (side * reach, 0, height - thick - 0.06))
    table.surfaces.append(around(across * 0.34, across * 0.34, height))
    # four seats between the legs
    table.seats = [
        Seat(float(across / 2 * np.cos(a)), float(across / 2 * np.sin(a)), float(a + np.pi / 2), 2 * reach - 0.06,
             across * 0.3, height - thick - 0.06)
        for a in np.arange(4) * np.pi / 2
    ]  # fmt: skip


def _pedestal(table: Assembly, style: Style, palette: Palette) -> None:
    """Build a round or oval table on one column."""
    top = palette.pick(palette.woods + palette.stones + palette.paints[:1])
    base = palette.pick([*palette.metals, *palette.woods, top])
    across, height, thick, stem = style["across"], style["height"], style["thick"], style["stem"]
    length = across * 1.4 if "oval" in style else across
    table.add(prism(ellipse(length, across), height - thick, height), top)
    foot = across * style["foot"] / 2
    profile = [
        (foot, 0),
        (foot, 0.02),
        (stem * 1.2, 0.07),
        (stem, 0.2),
        (stem, height - 0.2),
        (foot * 0.6, height - thick),
    ]
    table.add(lathe(profile, 28), base)
    table.surfaces.append(around(length * 0.33, across * 0.33, height))
    table.seats = _round_seats(length, across, across / 2 - stem * 1.2 - 0.1, height - thick)


BUILDERS: Mapping[str, Callable[[Assembly, Style, Palette], None]] = {
    **dict.fromkeys(("four_leg_table", "trestle_table", "panel_table", "x_table"), _rectangular),
    "boat_table": _boat,
    "round_table": _round,
    "pedestal_table": _pedestal,
}


def build_dining_table(style: Style, palette: Palette) -> Piece:
    """Build a dining table of one style with finishes of the palette."""
    table = Assembly(style.family.label, style.model)
    BUILDERS[style.family.name](table, style, palette)
    return table.finished()

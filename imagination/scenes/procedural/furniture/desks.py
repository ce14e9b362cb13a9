"""Desks with the wall at -y and the seat at +y."""

import numpy as np

from imagination.scenes.building_blocks.palette import Finish, Palette
from imagination.scenes.building_blocks.pieces import Assembly, Piece, Seat, Surface
from imagination.scenes.building_blocks.shapes import box
from imagination.scenes.procedural.furniture.styles import Style


def _chest(
    desk: Assembly, finish: Finish, knob: Finish, x: float, width: float, depth: float, height: float
) -> None:
    """Add a chest of drawers below the top."""
    desk.add(box(width, depth, height - 0.04), finish, (x, 0, 0.04))
    desk.add(box(width - 0.02, depth - 0.06, 0.04), knob, (x, 0, 0))
    step = (height - 0.07) / 3
    for number in range(3):
        low = 0.06 + number * step
        desk.add(box(width - 0.03, 0.016, step - 0.012), finish, (x, depth / 2 + 0.004, low))
        desk.add(box(0.1, 0.016, 0.014), knob, (x, depth / 2 + 0.018, low + step * 0.7))


def _legs(desk: Assembly, finish: Finish, style: Style, ends: tuple[float, ...]) -> None:
    """Add a pair of legs at each x in `ends`."""
    leg, y, under = style["leg"], style["depth"] / 2, style["height"] - style["thick"]
    for x in ends:
        for side in (-1, 1):
            desk.add(box(leg, leg, under), finish, (x, side * (y - leg / 2), 0))


def build_desk(style: Style, palette: Palette) -> Piece:
    """Build a desk of one style with finishes of the palette and one seat."""
    desk = Assembly(style.family.label, style.model)
    wood, metal = palette.pick(palette.woods + palette.paints[:1]), palette.pick(palette.metals)
    length, depth, height, thick = style["length"], style["depth"], style["height"], style["thick"]
    under, kind = height - thick, style.family.name
    desk.add(box(length, depth, thick), wood, (0, 0, under))
    left, right = -length / 2 + 0.05, length / 2 - 0.05
    if kind in ("panel_desk", "hutch_desk"):
        panel = style["leg"]
        for side in (-1, 1):
            desk.add(box(panel, depth * 0.97, under), wood, (side * (length - panel) / 2, 0, 0))
        desk.add(box(length - 2 * panel, 0.018, under * 0.5), wood, (0, -depth / 2 + 0.05, under * 0.5))
    elif kind == "drawer_desk":
        chest = min(style["chest"], (length - 0.62) / (2 if "two_chests" in style else 1))
        _chest(desk, wood, metal, (length - chest) / 2, chest, depth - 0.06, under)
        right -= chest
        if "two_chests" in style and chest > 0.22:
            _chest(desk, wood, metal, -(length - chest) / 2, chest, depth - 0.06, under)
            left += chest
        else:
            desk.add(box(0.03, depth * 0.95, under), wood, (-length / 2 + 0.02, 0, 0))
        desk.add(box(length - 0.05, 0.018, under * 0.5), wood, (0, -depth / 2 + 0.05, under * 0.5))
    else:
        leg = palette.pick([wood, metal])
        _legs(desk, leg, style, (-length / 2 + style["leg"] / 2, length / 2 - style["leg"] / 2))
        desk.add(box(length - 0.1, 0.02, 0.08), leg, (0, -depth / 2 + 0.04, under - 0.08))
    if kind == "corner_desk":
        wing, width = style["wing"], 0.48
        desk.add(box(width, wing, thick), wood, (-length / 2 + width / 2, depth / 2 + wing / 2, under))
        for x in (-length / 2 + 0.03, -length / 2 + width - 0.03):
            desk.add(box(0.04, 0.04, under), metal, (x, depth / 2 + wing - 0.03, 0))
        left += width
    if kind == "hutch_desk":
        deep, rise = 0.24, style["hutch"]
        for x in (-length / 2 + 0.012, 0, length / 2 - 0.012):
            desk.add(box(0.022, deep, rise), wood, (x, -depth / 2 + deep / 2, height))
        for z in (height + rise - 0.02, height + rise * 0.5):
            desk.add(box(length, deep, 0.02), wood, (0, -depth / 2 + deep / 2, z))
    if "drawer" in style:
        desk.add(box(length * 0.4, depth * 0.8, 0.07), wood, (length * 0.25, 0, under - 0.07))
    back = -depth / 2 + (0.26 if kind == "hutch_desk" else 0.0)
    desk.surfaces.append(
        Surface(-length / 2 + 0.02, back + 0.02, length / 2 - 0.02, depth / 2 - 0.08, height)
    )
    middle = float(np.clip((left + right) / 2, -length / 2, length / 2))
    desk.seats.append(
        Seat(middle, depth / 2, np.pi, right - left, depth - 0.12, under - 0.07 * ("drawer" in style))
    )
    return desk.finished()

"""Dining and kitchen chairs, which face +y."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import Assembly, Piece
from imagination.scenes.building_blocks.shapes import bent, box, cushion, ellipse, lathe, prism, rounded, tube
from imagination.scenes.procedural.furniture.chair_parts import CORNERS, backrest, bowl, wooden_arms
from imagination.scenes.procedural.furniture.styles import Style


def _wooden(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a chair with four legs and a wooden or padded back."""
    frame, leg, splay = palette.pick(palette.woods + palette.paints[:1]), style["leg"], style["splay"]
    width, depth, seat = style["width"], style["depth"], style["seat"]
    x, y = width / 2 - leg / 2, depth / 2 - leg / 2
    thick = style["pad"] - 0.01 if style.family.name == "upholstered" else 0.025
    for sx, sy in CORNERS:
        foot = (sx * (x + splay), sy * y + (-splay if sy < 0 else splay / 2), 0.0)
        chair.add(tube([foot, (sx * x, sy * y, seat - thick)], [leg * 0.55, leg * 0.71], 4), frame)
    apron = 0.05
    for side in (-y, y):
        chair.add(box(width - 2 * leg, 0.02, apron), frame, (0, side, seat - thick - apron))
    for side in (-x, x):
        chair.add(box(0.02, depth - 2 * leg, apron), frame, (side, 0, seat - thick - apron))
    if "stretchers" in style:
        for side in (-x, x):
            chair.add(box(0.02, depth - leg, 0.025), frame, (side + np.sign(side) * splay / 2, 0, seat * 0.4))
    if style.family.name == "upholstered":
        cloth = palette.pick(palette.fabrics + palette.leathers)
        pad = style["pad"]
        chair.add(cushion(width, depth, pad, 0.03, 0.015), cloth, (0, 0, seat - pad))
        back = cushion(width * 0.98, pad * 0.8, style["back"] + pad, 0.03)
        chair.add(back, cloth, (0, -depth / 2 + pad * 0.4, seat - pad), tilt=style["rake"])
        return
    chair.add(prism(rounded(width, depth, 0.03, 3), 0, thick), frame, (0, 0, seat - thick))
    if "pad" in style:
        chair.add(
            cushion(width * 0.92, depth * 0.92, 0.04, 0.015, 0.01),
            palette.pick(palette.fabrics),
            (0, 0.01, seat),
        )
    backrest(chair, style, frame, -y, min(leg, 0.035))
    if "arms" in style:
        wooden_arms(chair, style, frame)


def _spindle(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a spindle-back chair: a carved seat on splayed turned legs, and a bent hoop with thin spindles."""
    frame, leg, seat = palette.pick(palette.woods), style["leg"], style["seat"]
    width, depth, back = style["width"], style["depth"], style["back"]
    for sx, sy in CORNERS:
        foot = (sx * (width / 2 - 0.03 + style["splay"]), sy * (depth / 2 - 0.03 + style["splay"]), 0.0)
        top = (sx * (width / 2 - 0.10), sy * (depth / 2 - 0.10), seat - 0.03)
        middle = tuple(0.5 * (a + b) for a, b in zip(foot, top, strict=True))
        chair.add(tube([foot, middle, top], [leg * 0.32, leg * 0.55, leg * 0.35], 8), frame)
    for side in (-1, 1):
        reach = side * (width / 2 - 0.065 + style["splay"] / 2)
        chair.add(
            tube([(reach, -depth / 2 + 0.06, seat * 0.42), (reach, depth / 2 - 0.06, seat * 0.42)], 0.01, 6),
            frame,
        )
    chair.add(prism(rounded(width, depth, width * 0.3, 5), 0, 0.04), frame, (0, 0, seat - 0.04))
    base, angle = (0.0, -depth / 2 + 0.05, seat), np.linspace(0, np.pi, 13)
    half = width / 2 - 0.03
    hoop = np.column_stack([half * np.cos(angle) ** 1, np.zeros(13), back * np.sin(angle) ** 0.5])
    chair.add(tube(hoop.tolist(), 0.013, 6), frame, base, tilt=style["rake"])
    count = max(4, int(2 * half / (style["slat"] + style["gap"])))
    for x in np.linspace(-half, half, count + 2)[1:-1]:
        height = back * (1 - (x / half) ** 2) ** 0.25
        chair.add(tube([(x, 0, 0), (x, 0, height)], style["slat"] / 2, 5), frame, base, tilt=style["rake"])
    if "arms" in style:
        wooden_arms(chair, style, frame)


def _seat_and_back(chair: Assembly, style: Style, palette: Palette) -> None:
    """Add the seat and the back of a tubular chair."""
    boards = palette.pick(palette.woods + palette.plastics + palette.fabrics)
    width, depth, seat, gap = style["width"], style["depth"], style["seat"], style["gap"]
    chair.add(cushion(width - 0.02, depth, 0.03, 0.012), boards, (0, 0, seat - 0.03))
    if "pad" in style:
        chair.add(
            cushion(width * 0.9, depth * 0.9, 0.035, 0.015), palette.pick(palette.fabrics), (0, 0, seat)
        )
    low = min(gap, style["back"] * 0.5)
    back = cushion(width - 0.04, 0.025, style["back"] - low, 0.012).moved((0, 0.02, low))
    chair.add(back, boards, (0, -depth / 2, seat), tilt=style["rake"])


def _tubular(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a chair of bent tube: sled base, or cantilever frame that is open at the back."""
    metal, radius = palette.pick(palette.metals), style["tube"]
    x, y, seat = style["width"] / 2, style["depth"] / 2, style["seat"]
    under, top, lean = seat - 0.03 - radius, seat + style["back"], np.tan(style["rake"])
    for side in (-x, x):
        post = [(side, -y, under), (side, -y - (top - under) * lean, top)]
        floor = [(side, y, radius), (side, -y, radius)]
        if style.family.name == "sled":
            path = [(side, y, under), *floor, *post]
        else:
            path = [floor[1], floor[0], (side, y, under), *post]
        chair.add(tube(bent(path, 0.06), radius, 8), metal)
        if "arms" in style:
            arm = [
                (side, -y - 0.21 * lean, seat + 0.21),
                (side, y * 0.6, seat + 0.21),
                (side, y * 0.7, under),
            ]
            chair.add(tube(bent(arm, 0.05), radius, 6), metal)
    for end in [y] if style.family.name == "sled" else [-y, y]:
        chair.add(tube([(-x, end, radius), (x, end, radius)], radius * 0.95, 6), metal)
    for end in (-y, y):
        chair.add(tube([(-x, end, under), (x, end, under)], radius * 0.95, 6), metal)
    _seat_and_back(chair, style, palette)


def _shell(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a moulded shell on four thin legs."""
    bowl(chair, style, palette.pick(palette.plastics + palette.fabrics))
    legs, radius, seat = palette.pick(palette.woods + palette.metals), style["leg"], style["seat"]
    for sx, sy in CORNERS:
        top = (sx * style["width"] * 0.28, sy * style["depth"] * 0.30, seat - 0.012)
        foot = (
            sx * (style["width"] * 0.36 + style["splay"]),
            sy * (style["depth"] * 0.38 + style["splay"]),
            0.0,
        )
        chair.add(tube([foot, top], [radius * 0.7, radius], 8), legs)
        chair.add(tube([top, (0.0, top[1], seat - 0.02)], 0.008, 5), palette.dark)


def _tulip(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a moulded shell on one foot."""
    finish = palette.pick(palette.plastics + palette.paints)
    bowl(chair, style, finish)
    stem, foot, seat = style["stem"], style["foot"], style["seat"]
    chair.add(
        lathe([(foot, 0), (foot, 0.012), (stem * 1.3, 0.06), (stem, 0.2), (stem * 1.4, seat - 0.012)], 24),
        finish,
    )
    if "pad" in style:
        chair.add(cushion(style["width"] * 0.75, style["depth"] * 0.8, 0.05, 0.02, 0.01), palette.pick(palette.fabrics),
                  (0, 0, seat))  # fmt: skip


def _bistro(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a bistro chair: a round seat on a wire frame with two concentric hoops as back."""
    metal, seat, radius = palette.pick(palette.metals + palette.paints[:1]), style["seat"], style["tube"]
    width, depth, splay = style["width"], style["depth"], style["splay"]
    for sx, sy in CORNERS:
        top = (sx * width * 0.33, sy * depth * 0.33, seat - 0.03)
        chair.add(tube([(top[0] + sx * splay, top[1] + sy * splay, 0.0), top], radius, 7), metal)
    chair.add(
        prism(ellipse(width, depth), 0, 0.035),
        palette.pick(palette.woods + palette.fabrics),
        (0, 0, seat - 0.035),
    )
    angle, base = np.linspace(0, np.pi, 13), (0.0, -depth / 2 + 0.07, seat - 0.03)
    for scale in (1.0, style["hoop"]):
        reach = [width * 0.42 * scale, 0.0, style["back"] * (0.55 + 0.45 * scale)]
        hoop = np.column_stack([np.cos(angle), np.zeros(13), np.sin(angle) ** 0.6]) * reach
        chair.add(tube(hoop.tolist(), radius, 6), metal, base, tilt=style["rake"])


def _folding(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a folding chair: crossed legs of flat bars, with seat and back of slats."""
    frame, leg, slat = palette.pick(palette.woods + palette.metals), style["leg"], style["slat"]
    width, depth, seat, back = style["width"], style["depth"], style["seat"], style["back"]
    x, y, lean = width / 2 - leg / 2, depth / 2, np.tan(style["rake"])
    for side in (-1, 1):
        upright = [
            (side * x, y, leg * 0.4),
            (side * x, -y * 0.6, seat),
            (side * x, -y * 0.6 - back * lean, seat + back),
        ]
        chair.add(tube(upright, leg * 0.6, 4), frame)
        chair.add(
            tube([(side * (x - leg), -y, leg * 0.4), (side * (x - leg), y * 0.7, seat - 0.02)], leg * 0.6, 4),
            frame,
        )
    count = max(3, int(depth / (slat + 0.012)))
    for position in np.linspace(-y + slat / 2, y - slat / 2, count):
        chair.add(box(width, slat * 0.9, 0.018), frame, (0, float(position), seat - 0.018))
    for height in (back - slat, back * 0.45):
        at = (0, -y * 0.6 - height * lean, seat + height)
        chair.add(box(width, 0.016, slat), frame, at, tilt=style["rake"])


BUILDERS: Mapping[str, Callable[[Assembly, Style, Palette], None]] = {
    **dict.fromkeys(("slat_back", "ladder_back", "panel_back", "upholstered"), _wooden),
    **dict.fromkeys(("sled", "cantilever"), _tubular),
    "spindle_back": _spindle,
    "shell": _shell,
    "tulip": _tulip,
    "bistro": _bistro,
    "folding": _folding,
}


def build_chair(style: Style, palette: Palette) -> Piece:
    """Build a chair of one style with finishes of the palette."""
    chair = Assembly(style.family.label, style.model)
    BUILDERS[style.family.name](chair, style, palette)
    return chair.finished()

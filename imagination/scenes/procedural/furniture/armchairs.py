"""Armchairs, which face +y."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import Assembly, Piece
from imagination.scenes.building_blocks.shapes import box, cushion, prism, rounded, sheet, tube
from imagination.scenes.procedural.furniture.chair_parts import feet
from imagination.scenes.procedural.furniture.styles import Style


def _easy(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a club or wing chair: padded, with closed sides."""
    cloth = palette.pick(palette.fabrics + palette.leathers)
    width, depth, seat, arm, lift = style["width"], style["depth"], style["seat"], style["arm"], style["lift"]
    whole, rear = width + 2 * arm, 0.16
    feet(chair, palette.pick(palette.woods + palette.metals), whole, depth + rear, lift)
    chair.add(cushion(whole, depth + rear, seat - 0.13 - lift, 0.03), cloth, (0, 0, lift))
    front = (depth + rear) / 2
    chair.add(cushion(width - 0.01, depth, 0.15, 0.05, 0.02), cloth, (0, front - depth / 2, seat - 0.14))
    rest = cushion(width + arm + 0.06, rear, style["back"] + 0.1, 0.05)
    chair.add(rest, cloth, (0, -front + rear / 2, seat - 0.1), tilt=style["rake"])
    for side in (-1, 1):
        x = side * (width + arm) / 2
        chair.add(
            cushion(arm, depth + rear * 0.7, seat + 0.2 - lift, min(0.05, arm * 0.45)),
            cloth,
            (x, rear * 0.15, lift),
        )
        if style.family.name == "wing":
            wing = cushion(0.07, depth * 0.5, style["back"] - 0.14, 0.03).moved((0, depth * 0.25, 0))
            chair.add(wing, cloth, (x, -front + rear / 2, seat + 0.19), tilt=style["rake"])
    if "pillow" in style:
        chair.add(cushion(0.36, 0.12, 0.34, 0.055, steps=2), palette.pick(palette.fabrics),
                  (0.03, -front + rear + 0.09, seat + 0.03), tilt=style["rake"] + 0.1)  # fmt: skip


def _frame_lounge(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build an open wooden frame with loose cushions."""
    frame, cloth, leg = (
        palette.pick(palette.woods),
        palette.pick(palette.fabrics + palette.leathers),
        style["leg"],
    )
    width, depth, seat, back = style["width"], style["depth"], style["seat"], style["back"]
    x, y = width / 2 + leg / 2, depth / 2 + 0.05
    for side in (-x, x):
        chair.add(box(leg, leg * 0.8, seat + 0.2), frame, (side, y - 0.05, 0))
        chair.add(tube([(side, -y - 0.05, 0), (side, -y + 0.06, seat + 0.2)], leg * 0.65, 4), frame)
        chair.add(box(max(style["arm"] * 0.8, leg), 2 * y + 0.05, 0.028), frame, (side, 0, seat + 0.2))
        chair.add(box(leg * 0.6, 2 * y - 0.1, 0.06), frame, (side, 0, seat - 0.17))
    for end in (y - 0.05, -y + 0.05):
        chair.add(box(width, leg * 0.7, 0.06), frame, (0, end, seat - 0.17))
    chair.add(cushion(width, depth + 0.08, 0.13, 0.045, 0.02), cloth, (0, 0.03, seat - 0.12))
    chair.add(cushion(width, 0.13, back, 0.05), cloth, (0, -depth / 2 + 0.02, seat), tilt=style["rake"])
    chair.add(box(width, 0.025, back * 0.9), frame, (0, -depth / 2 - 0.06, seat - 0.05), tilt=style["rake"])
    if "pillow" in style:
        chair.add(cushion(0.34, 0.11, 0.32, 0.05), palette.pick(palette.fabrics), (0, -depth / 2 + 0.15, seat + 0.03),
                  tilt=style["rake"] + 0.08)  # fmt: skip


def _tub(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a tub chair: one curved shell around a round seat."""
    cloth = palette.pick(palette.fabrics + palette.leathers)
    width, depth, seat, arm, lift = style["width"], style["depth"], style["seat"], style["arm"], style["lift"]
    across, deep = width + 2 * arm, depth + arm + 0.06
    feet(chair, palette.pick(palette.woods + palette.metals), across * 0.8, deep * 0.8, lift)
    angle = np.linspace(np.pi * 0.02, -np.pi * 1.02, 19)
    rise = np.linspace(0, 1, 5)
    crest = style["back"] * (0.45 + 0.55 * np.clip(np.sin(-angle), 0, 1))
    ring = np.stack([np.cos(angle) * (across / 2 - arm), np.sin(angle) * (deep / 2 - arm) * 1.25], axis=-1)
    ring[:, 1] += deep * 0.12
    points = np.zeros((5, 19, 3))
    points[..., :2] = ring[None] * (1 + 0.05 * np.sin(style["rake"]) * rise[:, None, None])
    points[..., 2] = lift + rise[:, None] * (seat - lift + crest)[None, :]
    chair.add(sheet(points, min(arm, 0.1)), cloth)
    chair.add(
        prism(rounded(width * 0.98, depth, width * 0.3, 5), 0, seat - 0.1 - lift), cloth, (0, 0.04, lift)
    )
    chair.add(cushion(width * 0.96, depth * 1.02, 0.13, 0.05, 0.02), cloth, (0, 0.05, seat - 0.11))


def _recliner(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a recliner: thick round arms, a high back of three rolls, and an optional foot rest."""
    cloth, seat, lift, arm = (
        palette.pick(palette.leathers + palette.fabrics),
        style["seat"],
        style["lift"],
        style["arm"],
    )
    width, depth, back, rear = style["width"], style["depth"], style["back"], 0.2
    deep = depth + rear
    chair.add(cushion(width + 2 * arm, deep, seat - 0.16 - lift, 0.04), cloth, (0, 0, lift))
    chair.add(box(width, deep * 0.8, lift + 0.01), palette.dark, (0, 0, 0))
    chair.add(cushion(width, depth, 0.18, 0.07, 0.03), cloth, (0, rear / 2, seat - 0.17))
    for side in (-1, 1):
        x = side * (width + arm) / 2
        chair.add(cushion(arm * 1.1, deep * 0.95, seat + 0.18 - lift, arm * 0.5), cloth, (x, 0.02, lift))
    base = (0, -deep / 2 + rear / 2, seat - 0.14)
    for number in range(3):
        low = number * (back + 0.1) / 3
        roll = cushion(width * 0.98, rear, (back + 0.1) / 3 + 0.03, 0.07, 0.02).moved((0, 0.01 * number, low))
        chair.add(roll, cloth, base, tilt=style["rake"])
    if style["rest"] > 0.08:
        chair.add(
            cushion(width * 0.95, style["rest"] + 0.1, 0.1, 0.04), cloth, (0, deep / 2 + 0.05, seat - 0.22)
        )


def _slipper(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a slipper chair: low and padded, without arms."""
    cloth, pad, lift = palette.pick(palette.fabrics + palette.leathers), style["pad"], style["lift"]
    width, depth, seat = style["width"], style["depth"], style["seat"]
    feet(chair, palette.pick(palette.woods + palette.metals), width, depth, lift)
    chair.add(cushion(width, depth, seat - lift, 0.05, 0.02), cloth, (0, 0, lift))
    rest = cushion(width, pad, style["back"] + 0.12, 0.05, 0.01)
    chair.add(rest, cloth, (0, -depth / 2 + pad / 2, seat - 0.12), tilt=style["rake"])
    if "pillow" in style:
        chair.add(cushion(0.34, 0.12, 0.32, 0.055), palette.pick(palette.fabrics),
                  (-0.04, -depth / 2 + pad + 0.08, seat + 0.02), tilt=style["rake"] + 0.1)  # fmt: skip


def _rocker(chair: Assembly, style: Style, palette: Palette) -> None:
    """Build a wooden rocking chair on two bent runners with a high slatted back."""
    frame, leg, seat = palette.pick(palette.woods), style["leg"], style["seat"]
    width, depth, back, slat = style["width"], style["depth"], style["back"], style["slat"]
    x, y, along = width / 2, depth / 2, np.linspace(-1, 1, 9)
    for side in (-x, x):
        runner = np.column_stack([np.full(9, side), along * (y + 0.16), leg * 0.5 + 0.09 * along**2])
        chair.add(tube(runner.tolist(), leg * 0.5, 5), frame)
        chair.add(tube([(side, y * 0.8, leg), (side, y * 0.8, seat + 0.2)], leg * 0.5, 5), frame)
        chair.add(tube([(side, -y * 0.8, leg), (side, -y * 0.8, seat)], leg * 0.5, 5), frame)
        chair.add(box(max(style["arm"] * 0.7, leg), 2 * y, 0.025), frame, (side, 0, seat + 0.2))
    chair.add(prism(rounded(width, depth, 0.05), 0, 0.035), frame, (0, 0, seat - 0.035))
    base, lean = (0.0, -y + 0.03, seat), style["rake"] + 0.1
    for end in (-x + leg / 2, x - leg / 2):
        chair.add(tube([(end, 0, 0), (end, 0, back)], leg * 0.5, 5), frame, base, tilt=lean)
    chair.add(box(width, 0.025, 0.09).moved((0, 0, back - 0.09)), frame, base, tilt=lean)
    count = max(3, int(width * 0.8 / (slat + 0.03)))
    for position in np.linspace(-x + 0.08, x - 0.08, count):
        chair.add(box(slat, 0.014, back - 0.05).moved((float(position), 0, 0)), frame, base, tilt=lean)
    if "pad" in style:
        chair.add(
            cushion(width * 0.92, depth * 0.9, 0.06, 0.025, 0.01), palette.pick(palette.fabrics), (0, 0, seat)
        )


BUILDERS: Mapping[str, Callable[[Assembly, Style, Palette], None]] = {
    **dict.fromkeys(("club", "wing"), _easy),
    "frame_lounge": _frame_lounge,
    "tub": _tub,
    "recliner": _recliner,
    "slipper": _slipper,
    "rocker": _rocker,
}


def build_armchair(style: Style, palette: Palette) -> Piece:
    """Build an armchair of one style with finishes of the palette."""
    chair = Assembly(style.family.label, style.model)
    BUILDERS[style.family.name](chair, style, palette)
    return chair.finished()

"""Beds with the wall side at -y: the headboard, or the long side of daybeds and bunk beds."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.building_blocks.palette import Finish, Palette
from imagination.scenes.building_blocks.pieces import Assembly, Piece
from imagination.scenes.building_blocks.shapes import box, cushion, lathe, sheet, tube
from imagination.scenes.procedural.furniture.styles import Style

MATTRESS = 0.20
"""Thickness of a mattress, metres."""


def _bedding(
    bed: Assembly, palette: Palette, width: float, length: float, top: float, y: float = 0.0
) -> None:
    """Add mattress, duvet and pillows; `top` is the height of the mattress top."""
    linen, cover = palette.pick(palette.linens), palette.pick(palette.fabrics + palette.linens)
    bed.add(cushion(width, length, MATTRESS, 0.05), linen, (0, y, top - MATTRESS))
    bed.add(
        cushion(width + 0.03, length * 0.66, 0.12, 0.05, 0.02), cover, (0, y + length * 0.165, top - 0.06)
    )
    count = 2 if width > 1.25 else 1
    for x in (np.arange(count) - (count - 1) / 2) * width / 2:
        at = (float(x), y - length / 2 + 0.28, top - 0.01)
        bed.add(cushion(min(width / count * 0.85, 0.75), 0.42, 0.10, 0.045, 0.03), linen, at, tilt=-0.12)


def _platform(bed: Assembly, style: Style, palette: Palette) -> None:
    """Build a platform bed: a low frame wider than its mattress."""
    wood, lip, lift = palette.pick(palette.woods), style["lip"], style["lift"]
    width, length, top = style["width"], style["length"], style["mattress"]
    base = top - MATTRESS + 0.04
    lift = min(lift, base - 0.08)
    bed.add(box(width + 2 * lip, length + lip, base - lift), wood, (0, lip / 2, lift))
    bed.add(box(width * 0.8, length * 0.85, lift), palette.dark)
    _bedding(bed, palette, width, length, top)
    bed.add(box(width + 2 * lip, 0.045, style["board"] * 0.85), wood, (0, -length / 2 - 0.025, 0))


def _panel(bed: Assembly, style: Style, palette: Palette) -> None:
    """Build a panel bed with posts and panels at head and foot."""
    wood, post = palette.pick(palette.woods + palette.paints[:1]), style["post"]
    width, length, top = style["width"] + 0.04, style["length"] + 0.02, style["mattress"]
    for y, height in ((-length / 2 - post / 2, style["board"]), (length / 2 + post / 2, style["foot"])):
        for side in (-1, 1):
            bed.add(box(post, post, height), wood, (side * (width + post) / 2, y, 0))
            if "knobs" in style:
                ball = [(0.01, 0), (post * 0.5, post * 0.4), (post * 0.45, post * 0.8), (0.005, post)]
                bed.add(lathe(ball, 10), wood, (side * (width + post) / 2, y, height))
        bed.add(box(width, post * 0.4, height - 0.28), wood, (0, y, 0.24))
    for side in (-1, 1):
        bed.add(box(0.03, length, 0.16), wood, (side * (width / 2 + post / 2), 0, top - MATTRESS - 0.06))
    bed.add(box(width, length, 0.03), wood, (0, 0, top - MATTRESS - 0.03))
    _bedding(bed, palette, style["width"], style["length"], top)


def _upholstered(bed: Assembly, style: Style, palette: Palette) -> None:
    """Build an upholstered bed: a padded frame and a tall headboard of padded panels."""
    cloth, pad = palette.pick(palette.fabrics + palette.leathers), style["pad"]
    width, length, top = style["width"] + 0.06, style["length"] + 0.03, style["mattress"]
    bed.add(cushion(width + 0.06, length + 0.03, top - MATTRESS + 0.02, 0.03), cloth, (0, 0.02, 0.04))
    count = max(2, round(width / 0.45))
    for x in (np.arange(count) - (count - 1) / 2) * (width + 0.06) / count:
        bed.add(
            cushion((width + 0.06) / count, pad, style["board"], 0.03),
            cloth,
            (float(x), -length / 2 - pad / 2, 0),
        )
    if "wings" in style:
        for side in (-1, 1):
            bed.add(
                cushion(0.08, 0.32, style["board"], 0.03),
                cloth,
                (side * (width / 2 + 0.04), -length / 2 + 0.1, 0),
            )
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        bed.add(box(0.05, 0.05, 0.06), palette.dark, (sx * width * 0.45, sy * length * 0.45, 0))
    _bedding(bed, palette, style["width"], style["length"], top)


def _four_poster(bed: Assembly, style: Style, palette: Palette) -> None:
    """Build a four-poster bed: tall posts that carry a frame."""
    wood, post, canopy = palette.pick(palette.woods), style["post"], style["canopy"]
    width, length, top = style["width"] + 0.06, style["length"] + 0.04, style["mattress"]
    for sx in (-1, 1):
        for sy in (-1, 1):
            bed.add(box(post, post, canopy), wood, (sx * (width + post) / 2, sy * (length + post) / 2, 0))
        bed.add(box(post * 0.7, length, 0.06), wood, (sx * (width + post) / 2, 0, canopy - 0.06))
        bed.add(box(width, post * 0.7, 0.06), wood, (0, sx * (length + post) / 2, canopy - 0.06))
        bed.add(box(0.03, length, 0.18), wood, (sx * (width + post) / 2, 0, top - MATTRESS - 0.08))
    bed.add(box(width, 0.03, style["board"] - 0.25), wood, (0, -(length + post) / 2, 0.25))
    bed.add(box(width, 0.03, 0.2), wood, (0, (length + post) / 2, top - MATTRESS - 0.08))
    bed.add(box(width, length, 0.03), wood, (0, 0, top - MATTRESS - 0.03))
    _bedding(bed, palette, style["width"], style["length"], top)


def _slats(bed: Assembly, style: Style, finish: Finish, y: float, height: float) -> None:
    """Add a headboard or footboard of upright slats between two posts."""
    width = style["width"] + 0.04
    for side in (-1, 1):
        bed.add(box(0.045, 0.045, height), finish, (side * (width / 2 + 0.0225), y, 0))
    for z in (height - 0.05, 0.26):
        bed.add(box(width, 0.03, 0.05), finish, (0, y, z))
    count = max(2, int(width / (style["slat"] + style["gap"])))
    for x in (np.arange(count) - (count - 1) / 2) * width / count:
        bed.add(box(style["slat"], 0.016, height - 0.34), finish, (float(x), y, 0.3))


def _single(bed: Assembly, style: Style, palette: Palette) -> None:
    """Build a single bed: slat bed, box bed, daybed with three sides, or sleigh bed."""
    wood, kind = palette.pick(palette.woods + palette.paints + palette.metals[:1]), style.family.name
    width, length, top = style["width"], style["length"], style["mattress"]
    end, base = length / 2 + 0.035, top - MATTRESS
    _bedding(bed, palette, width, length, top)
    if kind == "box_bed":
        lift = min(style["lift"], base - 0.1)
        bed.add(box(width + 0.04, length + 0.03, base - lift + 0.05), wood, (0, 0.0, lift))
        bed.add(box(width * 0.9, length * 0.9, lift), palette.dark)
        bed.add(box(width + 0.04, 0.04, style["board"]), wood, (0, -end, 0))
        if "drawers" in style:
            for y in (-length / 4, length / 4):
                for side in (-1, 1):
                    front = (side * (width / 2 + 0.025), y, lift + 0.02)
                    bed.add(box(0.014, length * 0.46, base - lift), wood, front)
        return
    bed.add(box(width, length, 0.03), wood, (0, 0, base - 0.03))
    for side in (-1, 1):
        bed.add(box(0.03, 2 * end, 0.12), wood, (side * (width / 2 + 0.02), 0, base - 0.06))
    if kind == "slat_bed":
        _slats(bed, style, wood, -end, style["board"])
        _slats(bed, style, wood, end, style["board"] * 0.75 if "footboard" in style else base + 0.30)
    elif kind == "daybed":
        post = style["post"]
        for y in (-end, end):
            for side in (-1, 1):
                bed.add(box(post, post, style["board"]), wood, (side * (width / 2 + 0.02), y, 0))
            bed.add(box(width, post * 0.5, style["board"] - top + 0.05), wood, (0, y, top - 0.05))
        bed.add(
            box(post * 0.5, 2 * end, style["board"] - top + 0.05), wood, (-width / 2 - 0.02, 0, top - 0.05)
        )
        bed.turn(np.pi / 2)  # the long side becomes the back
    else:
        _sleigh(bed, style, wood, end)


def _sleigh(bed: Assembly, style: Style, wood: Finish, end: float) -> None:
    """Add the outward-curved headboard and footboard of a sleigh bed."""
    for side, height in ((-1.0, style["board"]), (1.0, style["board"] * 0.8)):
        fraction = np.linspace(0, 1, 11)
        out, rise = style["curl"] * fraction**2.2, 0.1 + (height - 0.1) * fraction
        x = np.linspace(-0.5, 0.5, 5) * (style["width"] + 0.08)
        points = np.zeros((11, 5, 3))
        points[..., 0], points[..., 1], points[..., 2] = (
            x * -side,
            (side * (end + out))[:, None],
            rise[:, None],
        )
        bed.add(sheet(points, 0.035), wood)
        roll = (end + style["curl"]) * side
        half = style["width"] / 2 + 0.04
        bed.add(tube([(-half, roll, height), (half, roll, height)], 0.045, 10), wood)
        for foot in (-half + 0.04, half - 0.04):
            bed.add(box(0.07, 0.07, 0.14), wood, (foot, side * (end - 0.02), 0))


def _bunk(bed: Assembly, style: Style, palette: Palette) -> None:
    """Build a bunk bed with a ladder at the foot."""
    wood, post, upper = (
        palette.pick(palette.woods + palette.paints + palette.metals[:1]),
        style["post"],
        style["upper"],
    )
    width, length, top = style["width"], style["length"], style["mattress"]
    half, end = width / 2 + post / 2, length / 2 + post / 2
    for sx in (-1, 1):
        for sy in (-1, 1):
            bed.add(box(post, post, upper + 0.28), wood, (sx * half, sy * end, 0))
        for z in (top - MATTRESS, upper - MATTRESS, upper + 0.18):
            long = 2 * end if sx < 0 or z < upper else 2 * end * 0.65
            bed.add(box(0.03, long, 0.10), wood, (sx * half, (long - 2 * end) / 2, z - 0.02))
            bed.add(box(2 * half, 0.03, 0.10), wood, (0, sx * end, z - 0.02))
    for level in (top, upper):
        bed.add(box(width, length, 0.025), wood, (0, 0, level - MATTRESS - 0.025))
        _bedding(bed, palette, width, length, level)
    for y in (end - 0.05, end - 0.42):
        bed.add(box(0.035, 0.035, upper + 0.2), wood, (half + post / 2 + 0.02, y, 0))
    for z in np.arange(0.25, upper, 0.27):
        bed.add(box(0.03, 0.37, 0.03), wood, (half + post / 2 + 0.02, end - 0.235, float(z)))
    if "drawers" in style:
        bed.add(box(width * 0.95, length * 0.9, top - MATTRESS - 0.08), wood, (0, 0, 0.02))
    bed.turn(np.pi / 2)  # the long side opposite the ladder becomes the back


BUILDERS: Mapping[str, Callable[[Assembly, Style, Palette], None]] = {
    **dict.fromkeys(("slat_bed", "box_bed", "daybed", "sleigh_bed"), _single),
    **dict.fromkeys(("bunk_bed", "wide_bunk"), _bunk),
    "platform_bed": _platform,
    "panel_bed": _panel,
    "upholstered_bed": _upholstered,
    "four_poster_bed": _four_poster,
}


def build_bed(style: Style, palette: Palette) -> Piece:
    """Build a bed of one style with finishes of the palette."""
    bed = Assembly(style.family.label, style.model)
    BUILDERS[style.family.name](bed, style, palette)
    return bed.finished()

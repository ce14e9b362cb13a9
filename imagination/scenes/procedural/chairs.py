"""Chairs, office chairs and armchairs: they face +y, the back is at -y."""

from collections.abc import Callable, Mapping

import numpy as np

from imagination.scenes.procedural.pieces import Assembly, Piece
from imagination.scenes.procedural.shapes import bent, box, cushion, lathe, prism, rounded, sheet, tube
from imagination.scenes.procedural.styles import Style
from imagination.scenes.procedural.textures import Finish, Palette

CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def _backrest(chair: Assembly, style: Style, frame: Finish, y: float, post: float, upright: bool) -> None:
    """Two posts and what is between them: slats, rungs, spindles or a panel, according to the style's family."""
    half, base, top, rake = style["width"] / 2 - post / 2, style["seat"], style["back"], style["rake"]
    lean = {"at": (0.0, y, base), "tilt": rake}
    inner = 2 * half - post
    for side in (-half, half):
        bar = box(post, post, top).moved((side, 0.0, 0.0))
        chair.add(bar, frame, **lean)
    rail = 0.055
    if style.family.name == "ladder_back":
        step = style["slat"] + style["gap"]
        for number in range(max(2, int(top / step))):
            low = top - style["slat"] - number * step
            if low > 0.06:
                chair.add(box(inner, post * 0.5, style["slat"]).moved((0, 0, low)), frame, **lean)
        return
    chair.add(box(inner, post * 0.6, rail).moved((0, 0, top - rail)), frame, **lean)
    if upright:
        count = max(2, int((inner - style["gap"]) / (style["slat"] + style["gap"])))
        for x in (np.arange(count) - (count - 1) / 2) * inner / count:
            chair.add(box(style["slat"], post * 0.4, top - rail).moved((x, 0, 0)), frame, **lean)
    else:
        low = min(style["gap"], top * 0.5)
        chair.add(box(inner, post * 0.5, top - rail - low).moved((0, 0, low)), frame, **lean)


def _wooden(chair: Assembly, style: Style, palette: Palette) -> None:
    """Four legs and a wooden back."""
    frame, leg, splay = palette.pick(palette.woods + palette.paints[:1]), style["leg"], style["splay"]
    width, depth, seat = style["width"], style["depth"], style["seat"]
    x, y, thick = width / 2 - leg / 2, depth / 2 - leg / 2, 0.025
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
        chair.add(cushion(width * 0.92, depth * 0.92, 0.04, 0.015, 0.01), palette.pick(palette.fabrics), (0, 0.01, seat))
    _backrest(chair, style, frame, -y, min(leg, 0.035), style.family.name == "slat_back")
    if "arms" in style:
        _wooden_arms(chair, style, frame)


def _wooden_arms(chair: Assembly, style: Style, frame: Finish) -> None:
    height, y = 0.21, style["depth"] / 2
    reach = y * 0.55
    for side in (-1, 1):
        x = side * (style["width"] / 2 - 0.015)
        back = -y + 0.02 - height * np.tan(style["rake"])
        chair.add(box(0.045, reach - back, 0.025), frame, (x, (reach + back) / 2, style["seat"] + height))
        chair.add(box(0.028, 0.028, height), frame, (x, reach - 0.05, style["seat"]))


def _spindle(chair: Assembly, style: Style, palette: Palette) -> None:
    """A carved seat on splayed turned legs, a bent hoop with thin spindles."""
    frame, leg, seat = palette.pick(palette.woods), style["leg"], style["seat"]
    width, depth, back = style["width"], style["depth"], style["back"]
    for sx, sy in CORNERS:
        foot = (sx * (width / 2 - 0.03 + style["splay"]), sy * (depth / 2 - 0.03 + style["splay"]), 0.0)
        top = (sx * (width / 2 - 0.10), sy * (depth / 2 - 0.10), seat - 0.03)
        middle = tuple(0.5 * (a + b) for a, b in zip(foot, top, strict=True))
        chair.add(tube([foot, middle, top], [leg * 0.32, leg * 0.55, leg * 0.35], 8), frame)
    for side in (-1, 1):
        reach = side * (width / 2 - 0.065 + style["splay"] / 2)
        chair.add(tube([(reach, -depth / 2 + 0.06, seat * 0.42), (reach, depth / 2 - 0.06, seat * 0.42)], 0.01, 6), frame)
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
        _wooden_arms(chair, style, frame)


def _seat_and_back(chair: Assembly, style: Style, palette: Palette) -> None:
    """A board to sit on and one to lean on, for chairs of bent tube."""
    boards = palette.pick(palette.woods + palette.plastics + palette.fabrics)
    width, depth, seat, gap = style["width"], style["depth"], style["seat"], style["gap"]
    chair.add(cushion(width - 0.02, depth, 0.03, 0.012), boards, (0, 0, seat - 0.03))
    if "pad" in style:
        chair.add(cushion(width * 0.9, depth * 0.9, 0.035, 0.015), palette.pick(palette.fabrics), (0, 0, seat))
    low = min(gap, style["back"] * 0.5)
    back = cushion(width - 0.04, 0.025, style["back"] - low, 0.012).moved((0, 0.02, low))
    chair.add(back, boards, (0, -depth / 2, seat), tilt=style["rake"])


def _tubular(chair: Assembly, style: Style, palette: Palette) -> None:
    """Bent tube: runners on the floor (sled) or a frame open at the back (cantilever)."""
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
            arm = [(side, -y - 0.21 * lean, seat + 0.21), (side, y * 0.6, seat + 0.21), (side, y * 0.7, under)]
            chair.add(tube(bent(arm, 0.05), radius, 6), metal)
    for end in ([y] if style.family.name == "sled" else [-y, y]):
        chair.add(tube([(-x, end, radius), (x, end, radius)], radius * 0.95, 6), metal)
    for end in (-y, y):
        chair.add(tube([(-x, end, under), (x, end, under)], radius * 0.95, 6), metal)
    _seat_and_back(chair, style, palette)


def _bowl(chair: Assembly, style: Style, finish: Finish) -> None:
    """A moulded shell: seat and back in one curved sheet."""
    width, depth, back, bowl = style["width"], style["depth"], style["back"], style["bowl"]
    along, across = np.linspace(0, 1, 13), np.linspace(-1, 1, 9)
    lean = np.tan(style["rake"])
    bend = np.clip((along - 0.38) / 0.24, 0, 1)  # 0 on the seat, 1 on the back
    y = np.where(along < 0.5, depth / 2 - along / 0.5 * depth, -depth / 2 - (along - 0.5) / 0.5 * back * lean)
    z = np.where(along < 0.5, 0.0, (along - 0.5) / 0.5 * back) + 0.035 * np.sin(bend * np.pi)
    narrow = 1 - 0.22 * along**3
    x = across[None, :] * (width / 2 * narrow)[:, None]
    curl = bowl * across[None, :] ** 2 * np.ones(13)[:, None]
    points = np.stack([x, y[:, None] + curl * bend[:, None], z[:, None] + curl * (1 - bend[:, None]) * 0.7], axis=-1)
    chair.add(sheet(points, 0.014), finish, (0, 0, style["seat"]))
    if "arms" in style:
        for side in (-1, 1):
            path = [(side * width * 0.45, depth * 0.15, 0.0), (side * width * 0.5, depth * 0.2, 0.2),
                    (side * width * 0.5, -depth * 0.42, 0.2)]  # fmt: skip
            chair.add(tube(bent(path, 0.05), 0.013, 6), finish, (0, 0, style["seat"]))


def _shell(chair: Assembly, style: Style, palette: Palette) -> None:
    """A moulded shell on four thin legs."""
    _bowl(chair, style, palette.pick(palette.plastics + palette.fabrics))
    legs, radius, seat = palette.pick(palette.woods + palette.metals), style["leg"], style["seat"]
    for sx, sy in CORNERS:
        top = (sx * style["width"] * 0.28, sy * style["depth"] * 0.30, seat - 0.012)
        foot = (sx * (style["width"] * 0.36 + style["splay"]), sy * (style["depth"] * 0.38 + style["splay"]), 0.0)
        chair.add(tube([foot, top], [radius * 0.7, radius], 8), legs)
        chair.add(tube([top, (0.0, top[1], seat - 0.02)], 0.008, 5), palette.dark)


def _tulip(chair: Assembly, style: Style, palette: Palette) -> None:
    """A moulded shell on one foot."""
    finish = palette.pick(palette.plastics + palette.paints)
    _bowl(chair, style, finish)
    stem, foot, seat = style["stem"], style["foot"], style["seat"]
    chair.add(lathe([(foot, 0), (foot, 0.012), (stem * 1.3, 0.06), (stem, 0.2), (stem * 1.4, seat - 0.012)], 24), finish)
    if "pad" in style:
        chair.add(cushion(style["width"] * 0.75, style["depth"] * 0.8, 0.05, 0.02, 0.01), palette.pick(palette.fabrics),
                  (0, 0, seat))  # fmt: skip


def _star(chair: Assembly, style: Style, palette: Palette) -> None:
    """Five-star base with castors and a gas spring."""
    metal = palette.pick([*palette.metals, palette.dark])
    reach, turn = style["star"], 0.3
    for number in range(5):
        angle = turn + number * 2 * np.pi / 5
        tip = (reach * np.cos(angle), reach * np.sin(angle))
        chair.add(tube([(0, 0, 0.10), (*tip, 0.07)], [0.032, 0.018], 4), metal)
        chair.add(cushion(0.045, 0.045, 0.06, 0.02, steps=1), palette.dark, (*tip, 0), yaw=angle)
    chair.add(lathe([(0.03, 0.08), (0.03, style["seat"] * 0.6), (0.018, style["seat"] * 0.6), (0.018, style["seat"] - 0.05)], 12),
              palette.dark)  # fmt: skip
    chair.add(box(style["width"] * 0.4, style["depth"] * 0.5, 0.03), palette.dark, (0, 0, style["seat"] - 0.08))


def _swivel(chair: Assembly, style: Style, palette: Palette) -> None:
    """Office chairs."""
    cloth = palette.pick(palette.fabrics[:3] + palette.leathers + [palette.dark])
    width, depth, seat, back = style["width"], style["depth"], style["seat"], style["back"]
    _star(chair, style, palette)
    kind = style.family.name
    if kind == "bucket_swivel":
        _bowl(chair, style, cloth)
        return
    chair.add(cushion(width, depth, 0.08, 0.035, 0.015), cloth, (0, 0, seat - 0.07))
    at, rake = (0.0, -depth / 2 - 0.01, seat), style["rake"]
    if kind == "executive_swivel":
        chair.add(cushion(width * 0.96, style["pad"], back, 0.04), cloth, (0, -depth / 2 + 0.02, seat), tilt=rake)
        chair.add(cushion(width * 0.7, 0.04, back * 0.3, 0.018).moved((0, style["pad"] / 2, back * 0.66)), cloth,
                  (0, -depth / 2 + 0.02, seat), tilt=rake)  # fmt: skip
    else:
        low = style["gap"]
        chair.add(box(0.07, 0.02, low + back * 0.4).moved((0, -0.02, -0.05)), palette.dark, at, tilt=rake)
        chair.add(cushion(width * 0.9, 0.05, back - low, 0.022).moved((0, 0.01, low)), cloth, at, tilt=rake)
    if kind == "headrest_swivel":
        chair.add(box(0.05, 0.02, 0.16).moved((0, 0, back - 0.05)), palette.dark, at, tilt=rake)
        chair.add(cushion(width * 0.55, 0.06, 0.14, 0.028).moved((0, 0.02, back + 0.08)), cloth, at, tilt=rake)
    if "arms" in style:
        for side in (-1, 1):
            x = side * (width / 2 + 0.03)
            chair.add(box(0.03, 0.06, 0.24), palette.dark, (x, -0.02, seat - 0.05))
            chair.add(cushion(0.07, depth * 0.55, 0.035, 0.016, steps=1), palette.dark, (x, 0, seat + 0.18))
            chair.add(box(width * 0.25, 0.05, 0.02), palette.dark, (side * width * 0.42, -0.02, seat - 0.05))


def _feet(chair: Assembly, finish: Finish, width: float, depth: float, lift: float) -> None:
    for sx, sy in CORNERS:
        foot = (sx * (width / 2 - 0.06), sy * (depth / 2 - 0.06))
        chair.add(tube([(*foot, 0), (*foot, lift + 0.01)], [0.018, 0.028], 8), finish)


def _easy(chair: Assembly, style: Style, palette: Palette) -> None:
    """Padded armchairs with closed sides: club and wing."""
    cloth = palette.pick(palette.fabrics + palette.leathers)
    width, depth, seat, arm, lift = style["width"], style["depth"], style["seat"], style["arm"], style["lift"]
    whole, rear = width + 2 * arm, 0.16
    _feet(chair, palette.pick(palette.woods + palette.metals), whole, depth + rear, lift)
    chair.add(cushion(whole, depth + rear, seat - 0.13 - lift, 0.03), cloth, (0, 0, lift))
    front = (depth + rear) / 2
    chair.add(cushion(width - 0.01, depth, 0.15, 0.05, 0.02), cloth, (0, front - depth / 2, seat - 0.14))
    rest = cushion(width + arm, rear, style["back"] + 0.1, 0.05)
    chair.add(rest, cloth, (0, -front + rear / 2, seat - 0.1), tilt=style["rake"])
    for side in (-1, 1):
        x = side * (width + arm) / 2
        chair.add(cushion(arm, depth + rear * 0.7, seat + 0.2 - lift, min(0.05, arm * 0.45)), cloth, (x, rear * 0.15, lift))
        if style.family.name == "wing":
            wing = cushion(0.07, depth * 0.5, style["back"] - 0.14, 0.03).moved((0, depth * 0.25, 0))
            chair.add(wing, cloth, (x, -front + rear / 2, seat + 0.19), tilt=style["rake"])
    if "pillow" in style:
        chair.add(cushion(0.36, 0.12, 0.34, 0.055, steps=2), palette.pick(palette.fabrics),
                  (0.03, -front + rear + 0.09, seat + 0.03), tilt=style["rake"] + 0.1)  # fmt: skip


def _frame_lounge(chair: Assembly, style: Style, palette: Palette) -> None:
    """An open wooden frame with loose cushions."""
    frame, cloth, leg = palette.pick(palette.woods), palette.pick(palette.fabrics + palette.leathers), style["leg"]
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
    """A barrel: one curved wall around a round seat."""
    cloth = palette.pick(palette.fabrics + palette.leathers)
    width, depth, seat, arm, lift = style["width"], style["depth"], style["seat"], style["arm"], style["lift"]
    across, deep = width + 2 * arm, depth + arm + 0.06
    _feet(chair, palette.pick(palette.woods + palette.metals), across * 0.8, deep * 0.8, lift)
    angle = np.linspace(np.pi * 0.02, -np.pi * 1.02, 19)
    rise = np.linspace(0, 1, 5)
    crest = style["back"] * (0.45 + 0.55 * np.clip(np.sin(-angle), 0, 1))
    ring = np.stack([np.cos(angle) * (across / 2 - arm), np.sin(angle) * (deep / 2 - arm) * 1.25], axis=-1)
    ring[:, 1] += deep * 0.12
    points = np.zeros((5, 19, 3))
    points[..., :2] = ring[None] * (1 + 0.05 * np.sin(style["rake"]) * rise[:, None, None])
    points[..., 2] = lift + rise[:, None] * (seat - lift + crest)[None, :]
    chair.add(sheet(points, min(arm, 0.1)), cloth)
    chair.add(prism(rounded(width * 0.98, depth, width * 0.3, 5), 0, seat - 0.1 - lift), cloth, (0, 0.04, lift))
    chair.add(cushion(width * 0.96, depth * 1.02, 0.13, 0.05, 0.02), cloth, (0, 0.05, seat - 0.11))


BUILDERS: Mapping[str, Callable[[Assembly, Style, Palette], None]] = {
    **dict.fromkeys(("slat_back", "ladder_back", "panel_back", "upholstered"), _wooden),
    **dict.fromkeys(("sled", "cantilever"), _tubular),
    **dict.fromkeys(("task_swivel", "executive_swivel", "bucket_swivel", "headrest_swivel"), _swivel),
    **dict.fromkeys(("club", "wing"), _easy),
    "spindle_back": _spindle,
    "shell": _shell,
    "tulip": _tulip,
    "frame_lounge": _frame_lounge,
    "tub": _tub,
}


def build_chair(style: Style, palette: Palette) -> Piece:
    """A chair of one style in the finishes of one home."""
    chair = Assembly(style.family.label, style.model)
    BUILDERS[style.family.name](chair, style, palette)
    return chair.finished()

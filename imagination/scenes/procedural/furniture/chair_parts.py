"""Common parts of chairs, which face +y."""

import numpy as np

from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.building_blocks.pieces import Assembly
from imagination.scenes.building_blocks.shapes import Solid, bent, box, sheet, tube
from imagination.scenes.procedural.furniture.styles import Style

CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
"""Signs of x and y of the corners of a rectangle."""


def backrest(chair: Assembly, style: Style, frame: Finish, y: float, post: float) -> None:
    """Add two posts with slats, rungs or a panel between them, according to the family of the style.

    Args:
        chair: chair that is built.
        style: style of the chair.
        frame: finish of the frame.
        y: position of the posts, metres.
        post: thickness of the posts, metres.
    """
    half, top = style["width"] / 2 - post / 2, style["back"]
    inner, rail = 2 * half - post, 0.055

    def upright(solid: Solid) -> None:
        chair.add(solid, frame, (0.0, y, style["seat"]), tilt=style["rake"])

    for side in (-half, half):
        upright(box(post, post, top).moved((side, 0.0, 0.0)))
    if style.family.name == "ladder_back":
        step = style["slat"] + style["gap"]
        for number in range(max(2, int(top / step))):
            low = top - style["slat"] - number * step
            if low > 0.06:
                upright(box(inner, post * 0.5, style["slat"]).moved((0, 0, low)))
        return
    upright(box(inner, post * 0.6, rail).moved((0, 0, top - rail)))
    if style.family.name == "slat_back":
        count = max(2, int((inner - style["gap"]) / (style["slat"] + style["gap"])))
        for x in (np.arange(count) - (count - 1) / 2) * inner / count:
            upright(box(style["slat"], post * 0.4, top - rail).moved((float(x), 0, 0)))
    else:
        low = min(style["gap"], top * 0.5)
        upright(box(inner, post * 0.5, top - rail - low).moved((0, 0, low)))


def wooden_arms(chair: Assembly, style: Style, frame: Finish) -> None:
    """Add armrests on posts that stand on the seat."""
    height, y = 0.21, style["depth"] / 2
    reach = y * 0.55
    for side in (-1, 1):
        x = side * (style["width"] / 2 - 0.015)
        back = -y + 0.02 - height * np.tan(style["rake"])
        chair.add(box(0.045, reach - back, 0.025), frame, (x, (reach + back) / 2, style["seat"] + height))
        chair.add(box(0.028, 0.028, height), frame, (x, reach - 0.05, style["seat"]))


def bowl(chair: Assembly, style: Style, finish: Finish) -> None:
    """Add a moulded shell: seat and back as one curved sheet."""
    width, depth, back, bowl = style["width"], style["depth"], style["back"], style["bowl"]
    along, across = np.linspace(0, 1, 13), np.linspace(-1, 1, 9)
    lean = np.tan(style["rake"])
    bend = np.clip((along - 0.38) / 0.24, 0, 1)  # 0 on the seat, 1 on the back
    y = np.where(along < 0.5, depth / 2 - along / 0.5 * depth, -depth / 2 - (along - 0.5) / 0.5 * back * lean)
    z = np.where(along < 0.5, 0.0, (along - 0.5) / 0.5 * back) + 0.035 * np.sin(bend * np.pi)
    narrow = 1 - 0.22 * along**3
    x = across[None, :] * (width / 2 * narrow)[:, None]
    curl = bowl * across[None, :] ** 2 * np.ones(13)[:, None]
    points = np.stack(
        [x, y[:, None] + curl * bend[:, None], z[:, None] + curl * (1 - bend[:, None]) * 0.7], axis=-1
    )
    chair.add(sheet(points, 0.014), finish, (0, 0, style["seat"]))
    if "arms" in style:
        for side in (-1, 1):
            path = [(side * width * 0.45, depth * 0.15, 0.0), (side * width * 0.5, depth * 0.2, 0.2),
                    (side * width * 0.5, -depth * 0.42, 0.2)]  # fmt: skip
            chair.add(tube(bent(path, 0.05), 0.013, 6), finish, (0, 0, style["seat"]))


def feet(chair: Assembly, finish: Finish, width: float, depth: float, lift: float) -> None:
    """Add four short feet, `lift` high, below a body of `width` x `depth`."""
    for sx, sy in CORNERS:
        foot = (sx * (width / 2 - 0.06), sy * (depth / 2 - 0.06))
        chair.add(tube([(*foot, 0), (*foot, lift + 0.01)], [0.018, 0.028], 8), finish)

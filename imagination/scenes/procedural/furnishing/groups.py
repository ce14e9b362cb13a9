"""Things that belong together, in a frame whose back (-y) goes to a wall: table with chairs, desk, bed, sofa."""

from collections.abc import Sequence

import numpy as np

from imagination.scenes.building_blocks.pieces import Piece, Placed, Seat, Surface
from imagination.scenes.procedural.furniture.stock import Stock

GAP = 0.02
"""Between a chair and what it is pushed against, metres."""


def reach_under(chair: Piece, underside: float) -> float:
    """How far a chair goes under something at a height, front first, until a higher part of it touches."""
    higher = chair.vertices[chair.vertices[:, 2] > underside - 0.015]
    return float(chair.high[1] - higher[:, 1].max()) if len(higher) else float(chair.high[1] - chair.low[1])


def at_seat(chair: Piece, seat: Seat, stock: Stock, turn: float) -> Placed:
    """A chair at a table, pushed in by chance: mostly far in, now and then pulled out.

    Args:
        chair, seat: which and where.
        stock: of the home.
        turn: deviation of its yaw, radians.
    """
    rng = stock.rng
    deepest = min(reach_under(chair, seat.underside) - GAP, seat.depth)
    share = rng.uniform(0.65, 1.0) if rng.random() < 0.75 else rng.uniform(-0.6, 0.65)
    yaw = seat.yaw + float(rng.normal(0, turn))
    # a turned chair's corner comes further in
    inside = deepest * share - abs(np.sin(yaw - seat.yaw)) * (chair.high[0] - chair.low[0]) / 2
    forward = np.array([-np.sin(seat.yaw), np.cos(seat.yaw)])
    x, y = np.array([seat.x, seat.y]) + forward * (inside - chair.high[1])
    return Placed(chair, float(x), float(y), yaw)


def next_to(anchor: Piece, obj: Piece, side: float, gap: float = 0.03) -> Placed:
    """A thing to the left (-1) or right (1) of another, their backs in line."""
    x = anchor.high[0] + gap - obj.low[0] if side > 0 else anchor.low[0] - gap - obj.high[0]
    return Placed(obj, float(x), float(anchor.low[1] - obj.low[1]))


def before(anchor: Piece, obj: Piece, gap: float, yaw: float = 0.0) -> Placed:
    """A thing in front of another, turned by `yaw` about itself."""
    turned = Placed(obj, 0.0, 0.0, yaw).footprint()
    middle = (anchor.low[0] + anchor.high[0]) / 2 - (turned[:, 0].min() + turned[:, 0].max()) / 2
    return Placed(obj, float(middle), float(anchor.high[1] + gap - turned[:, 1].min()), yaw)


def on_top_of(support: Placed, stock: Stock, labels: Sequence[str], share: float) -> list[Placed]:
    """Things standing on a piece's surfaces, apart from each other.

    Args:
        support: what they stand on.
        stock: of the home.
        labels: of the things to choose from.
        share: of the surface's length that is tried, in steps of 0.3 m.
    """
    objects: list[Placed] = []
    for surface in support.piece.surfaces:
        slots = int((surface.x1 - surface.x0) / 0.3)
        for slot in range(slots):
            if not labels or not stock.chance(share):
                continue
            obj = stock.piece(labels[int(stock.rng.integers(len(labels)))])
            yaw = float(stock.rng.normal(0, 0.3))
            placed = _on(surface, obj, slot, slots, yaw, float(stock.rng.random()))
            if placed is not None:
                objects.append(placed.within(support.x, support.y, support.yaw, support.z))
    return objects


def _on(surface: Surface, obj: Piece, slot: int, slots: int, yaw: float, share: float) -> Placed | None:
    """A thing within one of the slots of a surface, None if it is too large."""
    corners = Placed(obj, 0.0, 0.0, yaw).footprint()
    low, high = corners.min(axis=0), corners.max(axis=0)
    width = (surface.x1 - surface.x0) / slots
    spare = surface.y1 - surface.y0 - (high[1] - low[1])
    if spare < 0 or high[0] - low[0] > width:
        return None
    x = surface.x0 + (slot + 0.5) * width - (low[0] + high[0]) / 2
    return Placed(obj, float(x), float(surface.y0 + spare * share - low[1]), yaw, surface.z)


def bed_group(stock: Stock, label: str) -> list[Placed]:
    """A bed with its headboard at the back, nightstands beside it, lamps and books on them."""
    bed = stock.piece(label)
    group = [Placed(bed)]
    if label == "bunk_bed":
        return group
    stand = stock.piece("nightstand" if stock.chance(0.8) else "side_table")
    both = label == "double_bed" and stock.chance(0.8)
    sides = [-1.0, 1.0] if both else [float(stock.rng.choice([-1, 1]))]
    for side in sides:
        place = next_to(bed, stand, side)
        group.append(place)
        if stock.chance(0.75):
            surface = max(stand.surfaces, key=lambda surface: surface.z)
            middle = (surface.x0 + surface.x1) / 2, (surface.y0 + surface.y1) / 2
            lamp = Placed(stock.piece("table_lamp"), *middle, 0.0, surface.z)
            group.append(lamp.within(place.x, place.y, place.yaw, place.z))
        else:
            group += on_top_of(place, stock, ["books", "vase"], 0.7)
    return group


def desk_group(stock: Stock) -> tuple[list[Placed], list[Placed]]:
    """A desk with its back to the wall and what stands on it; and the chair pushed in."""
    desk = stock.piece("desk")
    office = stock.chance(0.75)
    chair = stock.piece("office_chair" if office else "chair")
    (seat,) = desk.seats
    objects = [Placed(desk)]
    surface = desk.surfaces[0]
    monitor = stock.piece("monitor")
    if stock.chance(0.8) and surface.y1 - surface.y0 > monitor.high[1] - monitor.low[1]:
        objects.append(Placed(monitor, seat.x, float(surface.y0 - monitor.low[1]), 0.0, surface.z))
    far = [
        t
        for t in on_top_of(objects[0], stock, ["books", "vase", "table_lamp", "books"], 0.35)
        if abs(t.x - seat.x) > 0.5
    ]
    return objects + far, [at_seat(chair, seat, stock, 0.35 if office else 0.12)]


def dining_group(stock: Stock, most: int) -> tuple[list[Placed], list[Placed]]:
    """A table with what stands on it; and its chairs, all alike, at most `most`."""
    table = stock.piece("dining_table")
    chair = stock.piece("chair" if stock.chance(0.96) else "armchair")
    width = chair.high[0] - chair.low[0]
    seats = [seat for seat in table.seats if seat.width > width + 0.01]
    order = [seats[int(number)] for number in np.sort(stock.rng.permutation(len(seats))[:most])]
    chairs = [at_seat(chair, seat, stock, 0.07) for seat in order if stock.chance(0.94)]
    objects = [Placed(table)]
    if stock.chance(0.7):
        objects += on_top_of(objects[0], stock, ["vase", "bowl", "bowl", "books"], 0.22)
    return objects, chairs


def sofa_group(stock: Stock, rich: bool) -> list[Placed]:
    """A sofa at the back, a coffee table before it, if `rich` an armchair at its end, a rug under all."""
    sofa, table = stock.piece("sofa"), stock.piece("coffee_table")
    group = [Placed(sofa)]
    place = before(sofa, table, float(stock.rng.uniform(0.32, 0.5)))
    group += [place, *on_top_of(place, stock, ["books", "bowl", "vase"], 0.4)]
    if rich:
        chair, side = stock.piece("armchair"), float(stock.rng.choice([-1, 1]))
        turn = side * (np.pi / 2 + stock.rng.normal(0, 0.2))
        corners = Placed(chair, 0.0, 0.0, turn).footprint()
        reach = max(abs(sofa.high[0]), table.high[0] + 0.3) - 0.1
        x = side * reach - (corners[:, 0].min() if side > 0 else corners[:, 0].max())
        group.append(Placed(chair, float(x), float(place.y + stock.rng.uniform(-0.1, 0.3)), float(turn)))
    if stock.chance(0.6):
        rug = stock.piece("rug")
        group.append(Placed(rug, 0.0, place.y, 0.0))
    return group

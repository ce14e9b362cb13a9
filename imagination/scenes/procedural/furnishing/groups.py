"""Groups of furniture in a frame with the wall at the back (-y): table with chairs, desk, bed, sofa."""

from collections.abc import Sequence

import numpy as np

from imagination.scenes.building_blocks.pieces import Piece, Placed, Seat, Surface
from imagination.scenes.procedural.furniture.procedural_furniture import Stock

GAP = 0.02
"""Gap between a chair and the part that it is pushed against, metres."""


def depth_under(chair: Piece, underside: float) -> float:
    """Return how deep a chair fits, front first, under a part at the height `underside`, metres."""
    higher = chair.vertices[chair.vertices[:, 2] > underside - 0.015]
    return float(chair.high[1] - higher[:, 1].max()) if len(higher) else float(chair.high[1] - chair.low[1])


def at_seat(chair: Piece, seat: Seat, stock: Stock, turn: float) -> Placed:
    """Place a chair at a table at a random depth: usually far in, sometimes pulled out.

    Args:
        chair: chair to place.
        seat: place at the table.
        stock: stock of the home.
        turn: standard deviation of the yaw, radians.
    """
    rng = stock.rng
    max_depth = min(depth_under(chair, seat.underside) - GAP, seat.depth)
    fraction = rng.uniform(0.65, 1.0) if rng.random() < 0.75 else rng.uniform(-0.6, 0.65)
    yaw = seat.yaw + float(rng.normal(0, turn))
    # the corner of a turned chair extends further in
    depth = max_depth * fraction - abs(np.sin(yaw - seat.yaw)) * (chair.high[0] - chair.low[0]) / 2
    forward = np.array([-np.sin(seat.yaw), np.cos(seat.yaw)])
    x, y = np.array([seat.x, seat.y]) + forward * (depth - chair.high[1])
    return Placed(chair, float(x), float(y), yaw)


def next_to(anchor: Piece, obj: Piece, side: float, gap: float = 0.03) -> Placed:
    """Place an object to the left (-1) or right (1) of another with their backs aligned."""
    x = anchor.high[0] + gap - obj.low[0] if side > 0 else anchor.low[0] - gap - obj.high[0]
    return Placed(obj, float(x), float(anchor.low[1] - obj.low[1]))


def before(anchor: Piece, obj: Piece, gap: float, yaw: float = 0.0) -> Placed:
    """Place an object in front of another, rotated by `yaw` about its origin."""
    turned = Placed(obj, 0.0, 0.0, yaw).footprint()
    offset = (anchor.low[0] + anchor.high[0]) / 2 - (turned[:, 0].min() + turned[:, 0].max()) / 2
    return Placed(obj, float(offset), float(anchor.high[1] + gap - turned[:, 1].min()), yaw)


def on_top_of(support: Placed, stock: Stock, labels: Sequence[str], probability: float) -> list[Placed]:
    """Place objects on the surfaces of a piece without overlap.

    Args:
        support: piece that supports the objects.
        stock: stock of the home.
        labels: labels to draw the objects from.
        probability: probability of an object in each slot of 0.3 m.
    """
    objects: list[Placed] = []
    for surface in support.piece.surfaces:
        slots = int((surface.x1 - surface.x0) / 0.3)
        for slot in range(slots):
            if not labels or not stock.chance(probability):
                continue
            obj = stock.piece(labels[int(stock.rng.integers(len(labels)))])
            yaw = float(stock.rng.normal(0, 0.3))
            placed = _in_slot(surface, obj, slot, slots, yaw, float(stock.rng.random()))
            if placed is not None:
                objects.append(placed.within(support.x, support.y, support.yaw, support.z))
    return objects


def _in_slot(
    surface: Surface, obj: Piece, slot: int, slots: int, yaw: float, fraction: float
) -> Placed | None:
    """Place an object in one slot of a surface; return None if it is too large."""
    corners = Placed(obj, 0.0, 0.0, yaw).footprint()
    low, high = corners.min(axis=0), corners.max(axis=0)
    width = (surface.x1 - surface.x0) / slots
    slack = surface.y1 - surface.y0 - (high[1] - low[1])
    if slack < 0 or high[0] - low[0] > width:
        return None
    x = surface.x0 + (slot + 0.5) * width - (low[0] + high[0]) / 2
    return Placed(obj, float(x), float(surface.y0 + slack * fraction - low[1]), yaw, surface.z)


def bed_group(stock: Stock, label: str) -> list[Placed]:
    """Build a bed with its headboard at the back and nightstands with lamps and books next to it."""
    bed = stock.piece(label)
    group = [Placed(bed)]
    if label == "bunk_bed":
        return group
    stand = stock.piece("nightstand" if stock.chance(0.8) else "side_table")
    two_stands = label == "double_bed" and stock.chance(0.8)
    sides = [-1.0, 1.0] if two_stands else [float(stock.rng.choice([-1, 1]))]
    for side in sides:
        placed = next_to(bed, stand, side)
        group.append(placed)
        if stock.chance(0.75):
            surface = max(stand.surfaces, key=lambda surface: surface.z)
            centre = (surface.x0 + surface.x1) / 2, (surface.y0 + surface.y1) / 2
            lamp = Placed(stock.piece("table_lamp"), *centre, 0.0, surface.z)
            group.append(lamp.within(placed.x, placed.y, placed.yaw, placed.z))
        else:
            group += on_top_of(placed, stock, ["books", "vase"], 0.7)
    return group


def desk_group(stock: Stock) -> tuple[list[Placed], list[Placed]]:
    """Build a desk with objects on it, and its chair."""
    desk = stock.piece("desk")
    office = stock.chance(0.75)
    chair = stock.piece("office_chair" if office else "chair")
    (seat,) = desk.seats
    objects = [Placed(desk)]
    surface = desk.surfaces[0]
    monitor = stock.piece("monitor")
    if stock.chance(0.8) and surface.y1 - surface.y0 > monitor.high[1] - monitor.low[1]:
        objects.append(Placed(monitor, seat.x, float(surface.y0 - monitor.low[1]), 0.0, surface.z))
    others = [
        obj
        for obj in on_top_of(objects[0], stock, ["books", "vase", "table_lamp", "books"], 0.35)
        if abs(obj.x - seat.x) > 0.5
    ]
    return objects + others, [at_seat(chair, seat, stock, 0.35 if office else 0.12)]


def dining_group(stock: Stock, max_chairs: int) -> tuple[list[Placed], list[Placed]]:
    """Build a dining table with objects on it, and at most `max_chairs` chairs of one model."""
    table = stock.piece("dining_table")
    chair = stock.piece("chair" if stock.chance(0.96) else "armchair")
    width = chair.high[0] - chair.low[0]
    seats = [seat for seat in table.seats if seat.width > width + 0.01]
    order = [seats[int(number)] for number in np.sort(stock.rng.permutation(len(seats))[:max_chairs])]
    chairs = [at_seat(chair, seat, stock, 0.07) for seat in order if stock.chance(0.94)]
    objects = [Placed(table)]
    if stock.chance(0.7):
        objects += on_top_of(objects[0], stock, ["vase", "bowl", "bowl", "books"], 0.22)
    return objects, chairs


def sofa_group(stock: Stock, with_armchair: bool) -> list[Placed]:
    """Build a sofa with a coffee table in front, an armchair at its end if `with_armchair`, and often a rug."""
    sofa, table = stock.piece("sofa"), stock.piece("coffee_table")
    group = [Placed(sofa)]
    placed = before(sofa, table, float(stock.rng.uniform(0.32, 0.5)))
    group += [placed, *on_top_of(placed, stock, ["books", "bowl", "vase"], 0.4)]
    if with_armchair:
        chair, side = stock.piece("armchair"), float(stock.rng.choice([-1, 1]))
        turn = side * (np.pi / 2 + stock.rng.normal(0, 0.2))
        corners = Placed(chair, 0.0, 0.0, turn).footprint()
        reach = max(abs(sofa.high[0]), table.high[0] + 0.3) - 0.1
        x = side * reach - (corners[:, 0].min() if side > 0 else corners[:, 0].max())
        group.append(Placed(chair, float(x), float(placed.y + stock.rng.uniform(-0.1, 0.3)), float(turn)))
    if stock.chance(0.6):
        rug = stock.piece("rug")
        group.append(Placed(rug, 0.0, placed.y, 0.0))
    return group

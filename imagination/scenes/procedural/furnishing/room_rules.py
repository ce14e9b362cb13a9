"""Furnishing rules of each kind of room."""

from collections.abc import Callable, Mapping

from imagination.scenes.building_blocks.pieces import Piece, Placed
from imagination.scenes.procedural.floor_plan.plan import Plan, RoomKind
from imagination.scenes.procedural.furnishing.furnisher import Furnisher
from imagination.scenes.procedural.furnishing.groups import (
    bed_group,
    desk_group,
    dining_group,
    next_to,
    on_top_of,
    sofa_group,
)
from imagination.scenes.procedural.furnishing.placement import RoomFloor
from imagination.scenes.procedural.furniture.procedural_furniture import Stock


def _bedroom(room: Furnisher) -> None:
    stock, area = room.stock, room.floor.room.area
    wide = area > 10.5 and min(room.floor.room.size) > 2.7
    bed = "double_bed" if wide and stock.chance(0.75) else "bunk_bed" if stock.chance(0.3) else "single_bed"
    if room.against_wall(bed_group(stock, bed), clear=0.5, tries=50) is None:
        for label in ("single_bed", "single_bed", "bunk_bed"):
            if room.against_wall(bed_group(stock, label)[:1], tries=60) is not None:
                break
    elif bed == "single_bed" and area > 9 and stock.chance(0.5):
        room.against_wall([Placed(stock.piece("single_bed"))])
    room.stand("wardrobe", 0.9, clear=0.45)
    if area > 9.5 and stock.chance(0.6):
        room.against_wall(*desk_group(stock))
    room.stand("dresser", 0.4, clear=0.35, on_top=("vase", "books", "table_lamp"))
    room.loose("armchair", 0.35 if area > 12 else 0.15)
    room.loose("chair", 0.4)
    room.stand("shelf", 0.3)
    room.stand("bench", 0.1)
    _accessories(room, rug=0.4, clutter=1)


def _living(room: Furnisher) -> None:
    stock, area = room.stock, room.floor.room.area
    with_armchair = area > 15 and stock.chance(0.8)
    sofa = room.against_wall(sofa_group(stock, with_armchair), tries=40)
    if sofa is None:
        sofa = room.against_wall(sofa_group(stock, False)[:2], tries=40)
    tv_stand = [Placed(stock.piece("tv_stand"))]
    if sofa is not None and room.against_wall(tv_stand, clear=0.4, sides=[(sofa + 2) % 4]) is None:
        room.against_wall(tv_stand)
    if area > 24 and stock.chance(0.5):
        room.freely(sofa_group(stock, False)[:2])
    room.stand("shelf", 0.7)
    room.stand("sideboard", 0.4, clear=0.35, on_top=("vase", "books", "bowl", "table_lamp"))
    for chance in (0.6, 0.4, 0.4 if area > 20 else 0.0):
        room.loose("armchair", chance)
    room.loose("side_table", 0.55)
    for chance in (0.4, 0.3 if area > 20 else 0.0):
        room.loose("chair", chance)
    room.loose("pouf", 0.35)
    room.stand("floor_lamp", 0.7)
    _accessories(room, rug=0.1, clutter=1)


def _dining(room: Furnisher) -> None:
    chair = _table(room, 8)
    room.stand("sideboard", 0.75, clear=0.3, on_top=("vase", "bowl", "books", "table_lamp"))
    if chair is not None:  # spare chairs of the set stand at a wall
        for _ in range(int(room.rng.integers(0, 3))):
            room.against_wall([Placed(chair)])
    room.loose("chair", 0.25)
    room.stand("shelf", 0.35)
    room.stand("floor_lamp", 0.3)
    room.loose("armchair", 0.25)
    _accessories(room, rug=0.0, clutter=0)


def _table(room: Furnisher, max_chairs: int) -> Piece | None:
    """Place a dining table, in the room if it fits, else at a wall; return the model of its chairs."""
    for _ in range(3):
        objects, chairs = dining_group(room.stock, max_chairs)
        if room.freely(objects, chairs, tries=16) or room.against_wall(objects, chairs, tries=16) is not None:
            return chairs[0].piece if chairs else None
    return None


def _kitchen(room: Furnisher) -> None:
    stock = room.stock
    counter, fridge = stock.piece("kitchen_counter"), stock.piece("fridge")
    group = [Placed(counter)]
    if stock.chance(0.75):
        units = stock.piece("wall_units")
        if units.high[0] <= counter.high[0]:
            group.append(Placed(units, 0.0, float(counter.low[1] - units.low[1]), 0.0, 1.42))
    group += on_top_of(group[0], stock, ["bowl", "vase", "books"], 0.4)
    placed_fridge = next_to(counter, fridge, float(room.rng.choice([-1, 1])))
    if room.against_wall([*group, placed_fridge], clear=0.7) is None:
        # if the group is too long, retry without the fridge, then with other, usually shorter units
        for counters in (group, *([Placed(stock.piece("kitchen_counter"))] for _ in range(3))):
            if room.against_wall(counters, clear=0.6) is not None:
                break
        room.against_wall([Placed(fridge)], clear=0.5)
    if stock.chance(0.45):
        room.against_wall([Placed(stock.piece("kitchen_counter"))], clear=0.7)
    if room.floor.room.area > 8 and stock.chance(0.65):
        _table(room, 4)
    room.loose("stool", 0.4)
    room.loose("chair", 0.25)
    _accessories(room, rug=0.0, clutter=1)


def _office(room: Furnisher) -> None:
    stock = room.stock
    for chance in (1.0, 0.35):
        if stock.chance(chance):
            room.against_wall(*desk_group(stock), tries=40)
    room.stand("shelf")
    room.stand("shelf", 0.5)
    room.loose("armchair", 0.35)
    room.loose("chair", 0.4)
    room.loose("side_table", 0.25)
    if stock.chance(0.15):
        room.against_wall([Placed(stock.piece("single_bed"))])
    room.stand("sideboard", 0.25)
    _accessories(room, rug=0.3, clutter=2)


def _bathroom(room: Furnisher) -> None:
    room.stand("bath", 0.75)
    room.stand("basin", 1.0, clear=0.3)
    room.stand("toilet", 1.0, clear=0.3)
    room.stand("basket", 0.5)
    room.loose("stool", 0.2)


def _corridor(room: Furnisher) -> None:
    room.stand("bench", 0.3)
    room.stand("sideboard", 0.2)
    room.loose("chair", 0.15)
    room.hang(3)


def _accessories(room: Furnisher, rug: float, clutter: int) -> None:
    """Place plants, clutter, a rug and pictures."""
    room.stand("plant", 0.5)
    for _ in range(clutter):
        room.stand(str(room.rng.choice(["carton", "basket", "pouf"])), 0.45)
    if room.stock.chance(rug):
        room.freely([Placed(room.stock.piece("rug"))])
    room.hang(int(room.rng.integers(0, 4)))


RULES: Mapping[RoomKind, Callable[[Furnisher], None]] = {
    "bedroom": _bedroom,
    "living": _living,
    "dining": _dining,
    "kitchen": _kitchen,
    "office": _office,
    "bathroom": _bathroom,
    "corridor": _corridor,
}


def furnish(plan: Plan, stock: Stock, robot_radius: float) -> list[Placed]:
    """Furnish all rooms of a plan; without a dining room the table is in the living room or the kitchen."""
    furniture: list[Placed] = []
    without_dining_room = not any(room.kind == "dining" for room in plan.rooms)
    for number, room in enumerate(plan.rooms):
        furnisher = Furnisher(RoomFloor(plan, number, robot_radius), stock)
        if room.kind == "living" and without_dining_room:
            _table(furnisher, 6)
        RULES[room.kind](furnisher)
        furniture += furnisher.floor.placed
    return furniture

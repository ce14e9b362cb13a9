"""Scene source of rectangular rooms with one seat in the middle."""

from collections.abc import Mapping
from dataclasses import dataclass

from imagination.scenes.building_blocks.assembly import assemble, object_of
from imagination.scenes.building_blocks.palette import Finish
from imagination.scenes.building_blocks.pieces import Assembly, Placed
from imagination.scenes.building_blocks.shapes import Solid, box
from imagination.scenes.free_space import free_space
from imagination.scenes.scene import Lighting, Material, Scene
from imagination.scenes.source import SPLITS, Split
from imagination.utils.errors import check_choice


@dataclass(frozen=True)
class BoxRooms:
    """Rooms of 4 m by 4 m and more; the seat's label is "seat".

    Attributes:
        rooms: number of rooms in each split.
        robot_radius: radius of the robot, metres.
    """

    rooms: Mapping[str, int]
    robot_radius: float
    name: str = "box_rooms"

    def scenes(self, split: Split) -> list[str]:
        return [f"{split}_{number}" for number in range(self.rooms[split])]

    def load(self, scene: str) -> Scene:
        check_choice("scene", scene, [name for split in SPLITS for name in self.scenes(split)])
        side = 4.0 + 0.5 * int(scene.rpartition("_")[2])
        outside = box(side, side, 2.6)
        room = Solid(outside.vertices, outside.faces[:, ::-1])  # seen from inside
        objects = [
            _placed("building", room, (0.8, 0.8, 0.7)),
            _placed("seat", box(0.5, 0.5, 0.8), (0.7, 0.2, 0.2)),
        ]
        mesh = assemble(objects)  # the index of an object is its instance id; the building is 0
        seat = object_of(1, objects[1], "chair")
        return Scene(scene, mesh, Lighting(), (seat,), free_space(mesh, 0.0, self.robot_radius))

    def identity(self, scene: str) -> str:
        return f"{self.name} {scene}"

    def fingerprint(self, scene: str) -> str:
        return f"{scene} {self.robot_radius}"


def _placed(label: str, solid: Solid, colour: tuple[float, float, float]) -> Placed:
    piece = Assembly(label)
    piece.add(solid, Finish(Material(colour)))
    return Placed(piece.finished())

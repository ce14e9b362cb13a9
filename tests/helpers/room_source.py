"""Scene source of hand-made rooms, for tests that need scenes."""

from dataclasses import dataclass

import numpy as np

from imagination.scenes.scene import Scene
from imagination.scenes.source import Split
from imagination.utils.errors import UserError
from tests.helpers.rooms import tiny_room


@dataclass(frozen=True)
class Rooms:
    """Source of `count` tiny rooms in each split with different rotations."""

    count: int = 3
    name: str = "rooms"

    def scenes(self, split: Split) -> list[str]:
        if not self.count:
            raise UserError(f"rooms: got no scenes for the split {split!r}, expected count >= 1")
        return [f"{split}_{index}" for index in range(self.count)]

    def load(self, scene: str) -> Scene:
        split, index = scene.split("_")
        turn = 0.7 * int(index) + {"train": 0.0, "val": 0.2, "test": 0.4}[split]
        return tiny_room(turn=turn, size=(5.0 + 0.3 * int(index), 4.0))

    def identity(self, scene: str) -> str:
        return f"{self.name} {scene}"

    def fingerprint(self, scene: str) -> str:
        return f"rooms {scene} {np.pi:.2f}"

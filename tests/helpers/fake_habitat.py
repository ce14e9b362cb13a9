"""Fake of habitat-sim 0.3 with a tiny room; its behaviour was measured on the real simulator.

Its world has y up: (x, y, z) is (x, -z, y) of the room. The ray caster renders its images.
"""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imagination.geometry.camera import Camera
from imagination.scenes.renderer import Renderer
from tests.helpers.rooms import tiny_room

FLOOR = 0.4
FIRST_ID = 7
"""First semantic id; it differs from all instance ids."""

COLOR, DEPTH, SEMANTIC = 1, 2, 3


class Crash(BaseException):
    """Raised where the real simulator aborts the process."""


class Fake:
    """State of one fake module, and the defects that a test may set."""

    def __init__(self) -> None:
        self.room = tiny_room(turn=0.3, shift=(1.0, 2.0), floor_height=FLOOR)
        self.started = self.changed = self.renders = 0
        self.blind = self.no_floor = self.unnamed = False


class Pathfinder:
    def __init__(self, fake: Fake) -> None:
        self._fake = fake
        self.is_loaded = False
        self._rng = np.random.default_rng(0)

    def seed(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def _navigable_points(self) -> np.ndarray:
        free = self._fake.room.free_space
        x, y = free.grid.to_points(np.argwhere(free.mask)).T
        return np.stack([x, np.full_like(x, FLOOR + 0.05), -y], axis=-1)

    def get_random_navigable_point(self) -> np.ndarray:
        if not self.is_loaded:
            raise Crash("query to an unloaded pathfinder")
        points = self._navigable_points()
        return np.asarray(points[self._rng.integers(len(points))])

    def get_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        points = self._navigable_points()
        return points.min(axis=0) - 0.025, points.max(axis=0) + 0.025

    def get_topdown_view(self, metres_per_pixel: float, height: float) -> np.ndarray:
        low, high = self.get_bounds()
        rows, columns = np.ceil((high - low)[[2, 0]] / metres_per_pixel - 1e-6).astype(int)
        view = np.zeros((rows, columns), bool)
        points = self._navigable_points()
        row = ((points[:, 2] - low[2]) / metres_per_pixel).astype(int)
        column = ((points[:, 0] - low[0]) / metres_per_pixel).astype(int)
        view[row, column] = abs(height - FLOOR) < 0.5
        return view


class Simulator:
    def __init__(self, configuration: Any) -> None:
        self.fake.started += 1
        self.reconfigure(configuration)
        self.fake.changed -= 1

    fake: Fake

    def reconfigure(self, configuration: Any) -> None:
        self.fake.changed += 1
        simulator, (agent,) = configuration.parts
        if simulator.gpu_device_id != -1:
            raise Crash("no CUDA here")
        assert not simulator.enable_physics
        self._sensors = agent.sensor_specifications
        for sensor in self._sensors:
            assert sensor.position == sensor.orientation == [0.0, 0.0, 0.0]
            assert all(isinstance(value, float) for value in (*sensor.position, *sensor.orientation))
            assert sensor.sensor_type != COLOR or not simulator.pbr_image_based_lighting, "slow start"
        identity = SimpleNamespace(components=(1.0, 0.0, 0.0, 0.0))
        self._state = SimpleNamespace(position=(0.0, 0.0, 0.0), rotation=identity)
        self._renderer = Renderer(self.fake.room.mesh, self.fake.room.lighting)
        self.pathfinder = Pathfinder(self.fake)
        objects = [] if self.fake.unnamed else [_object(obj) for obj in self.fake.room.objects]
        self.semantic_scene = SimpleNamespace(objects=[None, *objects], levels=[])

    def recompute_navmesh(self, pathfinder: Pathfinder, settings: Any) -> bool:
        assert settings.cell_height == 0.05 and settings.agent_radius > 0
        pathfinder.is_loaded = not self.fake.no_floor
        return pathfinder.is_loaded

    def get_agent(self, number: int) -> Any:
        return SimpleNamespace(set_state=lambda state: setattr(self, "_state", state))

    def get_sensor_observations(self) -> dict[str, np.ndarray]:
        self.fake.renders += 1
        height, width = self._sensors[0].resolution
        camera = Camera.from_degrees(width, height, self._sensors[0].hfov, 1.0)
        w, x, y, z = self._state.rotation.components
        px, py, pz = (float(value) for value in self._state.position)
        columns = [_rotate((w, x, y, z), axis) for axis in ((1.0, 0, 0), (0, -1.0, 0), (0, 0, -1.0))]
        pose = np.eye(4)  # the optical axes in the room: right, down, forward
        for number, (cx, cy, cz) in enumerate(columns):
            pose[:3, number] = cx, -cz, cy
        pose[:3, 3] = px, -pz, py
        image = self._renderer.render(camera, pose)
        semantic = np.where(image.instance > 0, image.instance + FIRST_ID, 0).astype(np.uint32)
        colour = np.concatenate([image.rgb, np.full((height, width, 1), 255, np.uint8)], axis=-1)
        images = {COLOR: colour, DEPTH: image.depth, SEMANTIC: semantic * (0 if self.fake.blind else 1)}
        return {sensor.uuid: images[sensor.sensor_type] for sensor in self._sensors}

    def close(self) -> None:
        pass


def _rotate(q: tuple[float, float, float, float], v: tuple[float, float, float]) -> np.ndarray:
    """Rotate a vector by a quaternion w, x, y, z: q v q*."""
    w, u = q[0], np.array(q[1:])
    vector = np.array(v, float)
    return np.asarray(vector + 2 * np.cross(u, np.cross(u, vector) + w * vector))


def _object(obj: Any) -> Any:
    """Return an object of the semantic scene, with its box rotated about the vertical axis y."""
    x, y, z = obj.box.centre
    width, depth, height = obj.box.size
    half = np.array([width, height, depth]) / 2
    rotation = np.array([0.0, np.sin(obj.box.yaw / 2), 0.0, np.cos(obj.box.yaw / 2)])
    obb = SimpleNamespace(center=np.array([x, z, -y]), half_extents=half, rotation=rotation)
    category = SimpleNamespace(name=lambda: obj.label)
    return SimpleNamespace(
        id=f"0_{obj.instance}", semantic_id=obj.instance + FIRST_ID, category=category, obb=obb
    )


def install(monkeypatch: pytest.MonkeyPatch) -> Fake:
    """Install fake modules habitat_sim and quaternion, and return the state of the fake."""
    fake = Fake()
    record = lambda **values: type("Record", (SimpleNamespace,), values)  # noqa: E731
    module, numbers = ModuleType("habitat_sim"), ModuleType("quaternion")
    contents = {
        "Simulator": type("FakeSimulator", (Simulator,), {"fake": fake}),
        "__version__": "0.3.3",
        "SimulatorConfiguration": record(
            gpu_device_id=0, enable_physics=False, pbr_image_based_lighting=True
        ),
        "CameraSensorSpec": record(
            position=[0.0, 0.0, 0.0], orientation=[0.0, 0.0, 0.0], hfov=90.0, sensor_type=COLOR
        ),
        "SensorType": SimpleNamespace(COLOR=COLOR, DEPTH=DEPTH, SEMANTIC=SEMANTIC),
        "Configuration": lambda simulator, agents: SimpleNamespace(parts=(simulator, agents)),
        "AgentState": lambda position, rotation: SimpleNamespace(position=position, rotation=rotation),
        "NavMeshSettings": record(set_defaults=lambda self: None, cell_height=0.2),
        "agent": SimpleNamespace(AgentConfiguration=record()),
    }
    for name, value in contents.items():
        setattr(module, name, value)
    numbers.quaternion = lambda *components: SimpleNamespace(components=components)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "habitat_sim", module)
    monkeypatch.setitem(sys.modules, "quaternion", numbers)
    return fake

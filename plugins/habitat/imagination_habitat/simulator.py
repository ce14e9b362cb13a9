"""One simulator for a process: creating one takes long, changing its scene does not."""

from typing import Any

import numpy as np
from jaxtyping import Float

from imagination.geometry.camera import Camera
from imagination.scenes.renderer import Image
from imagination.utils.errors import UserError
from imagination_habitat.frames import camera_state

TALLEST = 1.5
"""Of the agent for the navmesh, metres: what is higher is passed under."""
CELL_HEIGHT = 0.05
"""Of the navmesh; with habitat-sim's own 0.2 its floor lies up to 0.2 m too high."""


def habitat_sim() -> Any:
    """The module.

    Raises:
        UserError: if it is not installed.
    """
    try:
        import habitat_sim as module
    except ImportError as error:
        raise UserError(
            "habitat-sim is not installed; it comes by conda: `conda install habitat-sim=0.3.3 headless -c conda-forge "
            "-c aihabitat`; `python -m imagination.doctor` says whether it is usable"
        ) from error
    return module


class Simulators:
    """Holds this process's simulator, and which scene it shows."""

    def __init__(self) -> None:
        self._simulator: Any = None
        self._shown: tuple[Any, ...] = ()

    def show(self, dataset: str, scene: str, camera: Camera, device: int) -> Any:
        """The simulator, showing a scene through a camera."""
        wanted = dataset, scene, camera, device
        if self._shown != wanted:
            module = habitat_sim()
            configuration = _configuration(module, dataset, scene, camera, device)
            self._shown = ()  # until it has changed, it shows nothing for sure
            if self._simulator is None:
                self._simulator = module.Simulator(configuration)
            else:
                self._simulator.reconfigure(configuration)
            self._shown = wanted
        return self._simulator

    def close(self) -> None:
        """Give the simulator's memory back."""
        if self._simulator is not None:
            self._simulator.close()
        self._simulator, self._shown = None, ()


SIMULATORS = Simulators()


class HabitatRenderer:
    """Renders one scene of Habitat, as the ray caster renders a mesh."""

    def __init__(self, dataset: str, scene: str, device: int, rows: dict[int, int]) -> None:
        self._of = dataset, scene
        self._device = device
        self._lookup = np.zeros(max(rows, default=0) + 1, np.int32)
        for semantic_id, instance in rows.items():
            self._lookup[semantic_id] = instance

    def render(self, camera: Camera, camera_to_world: Float[np.ndarray, "4 4"], colour: bool = True) -> Image:
        """What `camera` sees, always in colour; ids of the simulator that no object has become 0.

        Raises:
            UserError: if the simulator gives images of another form.
        """
        simulator = SIMULATORS.show(*self._of, camera, self._device)
        place, (w, x, y, z) = camera_state(camera_to_world)
        state = habitat_sim().AgentState(place.astype(np.float32), _numpy_quaternion(w, x, y, z))
        simulator.get_agent(0).set_state(state)
        seen = simulator.get_sensor_observations()
        depth = np.nan_to_num(np.asarray(seen["depth"], np.float32), nan=0.0, posinf=0.0, neginf=0.0)
        shape = camera.height, camera.width
        if depth.shape != shape or seen["color"].shape != (*shape, 4):
            raise UserError(
                f"habitat: got images of {seen['color'].shape} and {depth.shape}, expected {shape}; is this "
                "habitat-sim 0.3?"
            )
        semantic = np.asarray(seen["semantic"], np.int64)
        instance = self._lookup[np.where(semantic < len(self._lookup), semantic, 0)]
        hit = depth > 0
        rgb = np.where(hit[..., None], np.asarray(seen["color"], np.uint8)[..., :3], np.uint8(0))
        return Image(rgb, depth, np.where(hit, instance, np.int32(-1)).astype(np.int32))


def _numpy_quaternion(w: float, x: float, y: float, z: float) -> Any:
    """The kind of quaternion that AgentState takes: numpy-quaternion's, which habitat-sim brings."""
    import quaternion

    return quaternion.quaternion(w, x, y, z)


def _configuration(module: Any, dataset: str, scene: str, camera: Camera, device: int) -> Any:
    """Colour, depth and semantics from the agent's own place: the agent is the camera."""
    simulator = module.SimulatorConfiguration()
    simulator.scene_id = scene
    if dataset:
        simulator.scene_dataset_config_file = dataset
    simulator.gpu_device_id = device
    simulator.enable_physics = False
    if hasattr(simulator, "pbr_image_based_lighting"):
        simulator.pbr_image_based_lighting = False  # with it each start takes 12 to 26 s
    sensors = []
    for uuid, kind in (("color", "COLOR"), ("depth", "DEPTH"), ("semantic", "SEMANTIC")):
        sensor = module.CameraSensorSpec()
        sensor.uuid = uuid
        sensor.sensor_type = getattr(module.SensorType, kind)
        sensor.resolution = [camera.height, camera.width]
        sensor.hfov = float(np.degrees(camera.field_of_view))
        sensor.position = [0.0, 0.0, 0.0]
        sensor.orientation = [0.0, 0.0, 0.0]
        sensors.append(sensor)
    agent = module.agent.AgentConfiguration()
    agent.sensor_specifications = sensors
    return module.Configuration(simulator, [agent])


def make_navmesh(simulator: Any, robot_radius: float, scene: str) -> None:
    """Compute where a robot of this radius may be in the scene that is shown.

    Raises:
        UserError: if it may be nowhere.
    """
    settings = habitat_sim().NavMeshSettings()
    settings.set_defaults()
    settings.agent_radius = float(robot_radius)
    settings.agent_height = TALLEST
    settings.cell_height = CELL_HEIGHT
    made = simulator.recompute_navmesh(simulator.pathfinder, settings)
    # an unloaded pathfinder ends the whole process when it is asked anything
    if not made or not simulator.pathfinder.is_loaded:
        raise UserError(
            f"habitat: scene {scene} has no floor for a robot of radius {robot_radius} m; check that it loads with y "
            "up (a stage config says which way is up)"
        )

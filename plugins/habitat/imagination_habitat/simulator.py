"""Simulator and renderer of Habitat; a process keeps one simulator, since creating one is slow."""

from typing import Any

import numpy as np
from jaxtyping import Float

from imagination.geometry.camera import Camera
from imagination.scenes.renderer import Image
from imagination.utils.errors import UserError
from imagination_habitat.frames import camera_state

AGENT_HEIGHT = 1.5
"""Height of the agent in the navmesh, metres; higher obstacles are ignored."""
CELL_HEIGHT = 0.05
"""Cell height of the navmesh, metres; habitat-sim's default of 0.2 puts the floor up to 0.2 m too high."""


def habitat_sim() -> Any:
    """Return the module habitat_sim.

    Raises:
        UserError: if habitat-sim is not installed.
    """
    try:
        import habitat_sim as module
    except ImportError as error:
        raise UserError(
            "habitat-sim is not installed: `conda install habitat-sim=0.3.3 headless -c conda-forge -c aihabitat`; "
            "`python -m imagination.doctor` checks the installation"
        ) from error
    return module


class Simulators:
    """Holder of the simulator of this process and its current scene."""

    def __init__(self) -> None:
        self._simulator: Any = None
        self._current: tuple[Any, ...] = ()

    def show(self, dataset: str, scene: str, camera: Camera, device: int) -> Any:
        """Return the simulator with a scene and camera loaded."""
        requested = dataset, scene, camera, device
        if self._current != requested:
            module = habitat_sim()
            configuration = _configuration(module, dataset, scene, camera, device)
            self._current = ()  # stays empty if loading fails
            if self._simulator is None:
                self._simulator = module.Simulator(configuration)
            else:
                self._simulator.reconfigure(configuration)
            self._current = requested
        return self._simulator

    def close(self) -> None:
        """Close the simulator and free its memory."""
        if self._simulator is not None:
            self._simulator.close()
        self._simulator, self._current = None, ()


SIMULATORS = Simulators()


class HabitatRenderer:
    """Renderer of one scene of Habitat, with the interface of the ray caster.

    Args:
        dataset: scene data set config, or an empty string.
        scene: name of the scene.
        device: CUDA device, or -1.
        rows: instance id of each semantic id.
    """

    def __init__(self, dataset: str, scene: str, device: int, rows: dict[int, int]) -> None:
        self._scene = dataset, scene
        self._device = device
        self._lookup = np.zeros(max(rows, default=0) + 1, np.int32)
        for semantic_id, instance in rows.items():
            self._lookup[semantic_id] = instance

    def render(self, camera: Camera, camera_to_world: Float[np.ndarray, "4 4"], colour: bool = True) -> Image:
        """Render the view of a camera, always in colour; semantic ids without an object become 0.

        Raises:
            UserError: if the images of the simulator have an unexpected shape.
        """
        simulator = SIMULATORS.show(*self._scene, camera, self._device)
        position, (w, x, y, z) = camera_state(camera_to_world)
        state = habitat_sim().AgentState(position.astype(np.float32), _numpy_quaternion(w, x, y, z))
        simulator.get_agent(0).set_state(state)
        observations = simulator.get_sensor_observations()
        depth = np.nan_to_num(np.asarray(observations["depth"], np.float32), nan=0.0, posinf=0.0, neginf=0.0)
        shape = camera.height, camera.width
        if depth.shape != shape or observations["color"].shape != (*shape, 4):
            raise UserError(
                f"habitat: got images of {observations['color'].shape} and {depth.shape}, expected {(*shape, 4)} and "
                f"{shape}; check that habitat-sim has version 0.3"
            )
        semantic = np.asarray(observations["semantic"], np.int64)
        instance = self._lookup[np.where(semantic < len(self._lookup), semantic, 0)]
        hit = depth > 0
        rgb = np.where(hit[..., None], np.asarray(observations["color"], np.uint8)[..., :3], np.uint8(0))
        return Image(rgb, depth, np.where(hit, instance, np.int32(-1)).astype(np.int32))


def _numpy_quaternion(w: float, x: float, y: float, z: float) -> Any:
    """Return a quaternion of numpy-quaternion, a dependency of habitat-sim, as AgentState expects it."""
    import quaternion

    return quaternion.quaternion(w, x, y, z)


def _configuration(module: Any, dataset: str, scene: str, camera: Camera, device: int) -> Any:
    """Return a configuration with colour, depth and semantic sensors at the position of the agent."""
    simulator = module.SimulatorConfiguration()
    simulator.scene_id = scene
    if dataset:
        simulator.scene_dataset_config_file = dataset
    simulator.gpu_device_id = device
    simulator.enable_physics = False
    if hasattr(simulator, "pbr_image_based_lighting"):
        simulator.pbr_image_based_lighting = False  # it delays each start by 12 to 26 s
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
    """Compute the navmesh of the current scene for a robot radius, metres.

    Raises:
        UserError: if the navmesh is empty.
    """
    settings = habitat_sim().NavMeshSettings()
    settings.set_defaults()
    settings.agent_radius = float(robot_radius)
    settings.agent_height = AGENT_HEIGHT
    settings.cell_height = CELL_HEIGHT
    computed = simulator.recompute_navmesh(simulator.pathfinder, settings)
    # a query to an unloaded pathfinder aborts the process
    if not computed or not simulator.pathfinder.is_loaded:
        raise UserError(
            f"habitat: scene {scene}: found no floor for a robot of radius {robot_radius} m; check that the stage "
            "config sets the up axis to y"
        )

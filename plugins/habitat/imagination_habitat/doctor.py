"""Whether habitat-sim is there and usable, found out in a process of its own: it may end the whole process."""

import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec

from imagination.utils.diagnostics import Finding

VERSION = "0.3"
TRIAL = """
import habitat_sim
configuration = habitat_sim.SimulatorConfiguration()
configuration.scene_id = "NONE"
configuration.gpu_device_id = -1
sensor = habitat_sim.CameraSensorSpec()
sensor.uuid = "depth"
sensor.sensor_type = habitat_sim.SensorType.DEPTH
sensor.resolution = [8, 8]
agent = habitat_sim.agent.AgentConfiguration()
agent.sensor_specifications = [sensor]
simulator = habitat_sim.Simulator(habitat_sim.Configuration(configuration, [agent]))
assert simulator.get_sensor_observations()["depth"].shape == (8, 8), "it renders nothing"
simulator.close()
print("usable", habitat_sim.__version__)
"""
"""Makes a renderer, which needs a sensor, and looks once."""


def examine() -> Iterator[Finding]:
    """One finding: usable, or what is wrong."""
    if find_spec("habitat_sim") is None:
        yield Finding(
            "habitat-sim",
            None,
            "not installed; only data/scenes=habitat needs it (conda install habitat-sim)",
        )
        return
    done = subprocess.run([sys.executable, "-c", TRIAL], capture_output=True, text=True, timeout=120)
    words = done.stdout.split()
    if done.returncode != 0 or "usable" not in words:
        last = (done.stderr.strip().splitlines() or [f"it ended with code {done.returncode}"])[-1]
        yield Finding("habitat-sim", False, f"installed, but it cannot render: {last}")
    elif not words[-1].startswith(VERSION):
        yield Finding("habitat-sim", False, f"version {words[-1]}, expected {VERSION}.x")
    else:
        yield Finding("habitat-sim", True, f"version {words[-1]}, renders in software")

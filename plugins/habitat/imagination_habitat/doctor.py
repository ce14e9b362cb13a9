"""Check of the installation of habitat-sim, in a separate process since habitat-sim may abort it."""

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
assert simulator.get_sensor_observations()["depth"].shape == (8, 8), "no image was rendered"
simulator.close()
print("usable", habitat_sim.__version__)
"""
"""Program that renders one depth image."""


def examine() -> Iterator[Finding]:
    """Yield one finding: usable, or the problem."""
    if find_spec("habitat_sim") is None:
        yield Finding(
            "habitat-sim",
            None,
            "not installed; only data/scenes=habitat needs it (conda install habitat-sim)",
        )
        return
    done = subprocess.run([sys.executable, "-c", TRIAL], capture_output=True, text=True, timeout=120)
    output = done.stdout.split()
    if done.returncode != 0 or "usable" not in output:
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        yield Finding("habitat-sim", False, f"installed, but cannot render: {last}")
    elif not output[-1].startswith(VERSION):
        yield Finding("habitat-sim", False, f"got version {output[-1]}, expected {VERSION}.x")
    else:
        yield Finding("habitat-sim", True, f"version {output[-1]}, renders in software")

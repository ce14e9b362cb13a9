"""Map the live images of a robot: `python -m imagination.serve server=zenoh unit=chair.onnx` (server from a plugin)."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from typing import Protocol, runtime_checkable

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.config.plugin_registry import activate
from imagination.deployment import mapper_from_config
from imagination.geometry.rgbd import RgbdCamera
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.runs.command import command
from imagination.runs.folder import CONFIG, point_latest
from imagination.runs.hydra_folder import experiment_folder, new_run_folder
from imagination.runs.logging import logging_to
from imagination.utils import interrupts
from imagination.utils.atomic_io import write_text
from imagination.utils.errors import UserError, check_choice, install_command

log = logging.getLogger(__name__)


@runtime_checkable
class Server(Protocol):
    """Server that receives the images and poses of a robot and publishes maps."""

    def serve(self, make_mapper: Callable[[RgbdCamera], SemanticMapper]) -> None:
        """Map until the process is interrupted, and log skipped frames.

        Args:
            make_mapper: function that builds the mapper for the camera of the robot.

        Raises:
            UserError: if a required package is not installed, or the server cannot listen or connect.
        """


def validate(config: DictConfig) -> None:
    """Check the values of the config before any file is read.

    Raises:
        UserError: if no plugin provides the server, or a value is missing or out of range.
    """
    if (
        "server" not in config
    ):  # Hydra leaves out an option that does not exist, because the group is optional
        check_server(HydraConfig.get().runtime.choices["server"])
    mapper_from_config.validate(config)


def check_server(name: str) -> None:
    """Check that a plugin provides a server.

    Raises:
        UserError: if none does, with the servers that exist or the way to get one.
    """
    options = [option.split("/") for plugin in activate() for option in plugin.options]
    servers = [option for group, *_, option in options if group == "server"]
    if not servers:
        raise UserError(
            f"server: got {name!r}, expected a server of a plugin; copy plugins/ros of the repository into plugins/ of "
            f"this folder, and run: {install_command('ros')}"
        )
    check_choice("server", name, servers)


@command("serve", validate)
def main(config: DictConfig) -> None:
    """Map until interrupted, then save the map."""
    predictor = mapper_from_config.predictor_of(config)
    # checks the config before the server starts
    mapper_from_config.mapper_of(config, predictor, RgbdCamera.of(predictor.spec.camera))
    server: Server = instantiate(config.server, _convert_="all")
    mappers: list[SemanticMapper] = []

    def make_mapper(camera: RgbdCamera) -> SemanticMapper:
        mappers.append(mapper_from_config.mapper_of(config, predictor, camera))
        return mappers[-1]

    folder = new_run_folder(config)
    config.paths.run = str(folder)
    with logging_to(folder / "run.log"):
        write_text(folder / CONFIG, OmegaConf.to_yaml(config, resolve=True))
        try:
            server.serve(make_mapper)
        except KeyboardInterrupt:
            interrupts.report()
        finally:  # save the map also after an error
            if mappers and mappers[-1].frames:
                with interrupts.postponed():
                    mappers[-1].save(folder)
                    point_latest(folder, experiment_folder(config))
                log.info("Map: %s/ (map.yaml, map.png, semantic.npz, objects.geojson)", folder)
            else:
                log.error("error: no frame was mapped, so no map is saved")
    if interrupts.received():
        sys.exit(interrupts.exit_code())
    sys.exit(0 if mappers and mappers[-1].frames else 1)


if __name__ == "__main__":
    main()

"""Map live: `python -m imagination.serve server=zenoh unit=chair.onnx`. What listens and speaks comes from a plugin."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, runtime_checkable

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.config.plugin_registry import discover
from imagination.deployment import mapper_from_config
from imagination.geometry.rgbd import RgbdCamera
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.runs.command import command
from imagination.runs.folder import CONFIG, create_folder, now, point_latest
from imagination.runs.logging import logging_to
from imagination.utils.atomic_io import write_text

log = logging.getLogger(__name__)


@runtime_checkable
class Server(Protocol):
    """Receives a robot's images and poses, and publishes maps."""

    def serve(self, make_mapper: Callable[[RgbdCamera], SemanticMapper]) -> None:
        """Map until the process is interrupted. Logs what was left out.

        Args:
            make_mapper: makes the mapper once the camera is known.

        Raises:
            UserError: if what the server needs is not installed, or it cannot listen or connect.
        """


@command("serve", mapper_from_config.validate)
def serve(config: DictConfig) -> None:
    """Serve until interrupted, then save the map."""
    module = mapper_from_config.module_of(config)
    mapper_from_config.mapper_of(
        config, module, RgbdCamera.of(module.spec.camera)
    )  # mistakes show before it listens
    server: Server = instantiate(config.server, _convert_="all")
    mappers: list[SemanticMapper] = []

    def make_mapper(camera: RgbdCamera) -> SemanticMapper:
        mappers.append(mapper_from_config.mapper_of(config, module, camera))
        return mappers[-1]

    folder = create_folder(Path(config.paths.outputs) / config.name, now())
    config.paths.run = str(folder)
    with logging_to(folder / "run.log"):
        write_text(folder / CONFIG, OmegaConf.to_yaml(config, resolve=True))
        try:
            server.serve(make_mapper)
        finally:  # whatever ended it, the map is kept
            if mappers and mappers[-1].frames:
                mappers[-1].save(folder)
                point_latest(folder)
                log.info("Map: %s/ (map.yaml, map.png, semantic.npz, objects.geojson)", folder)
            else:
                log.error("error: no frame could be mapped; nothing is saved")
    sys.exit(0 if mappers and mappers[-1].frames else 1)


def main() -> None:
    """The command, if there is a plugin that serves."""
    options = [option for plugin in discover() if not plugin.problem for option in plugin.options]
    if not any(option.startswith("server/") for option in options):
        sys.exit(
            "error: serve: found no plugin that serves; put the folder plugins/ros of the repository into plugins/ of "
            "this folder, and pip install 'imagination[ros]'"
        )
    serve()


if __name__ == "__main__":
    main()

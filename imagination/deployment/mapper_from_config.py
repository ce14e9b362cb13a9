"""A mapper as conf/mapper.yaml describes it."""

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.config.validation import check_name
from imagination.deployment.load import load
from imagination.geometry.grid import Grid
from imagination.geometry.rgbd import RgbdCamera
from imagination.mapping.map_io import load_layer
from imagination.mapping.predictor import ImaginationModule
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.utils.errors import UserError, check_range


def validate(config: DictConfig) -> None:
    """Check what the user may have got wrong before anything is read.

    Raises:
        UserError: on the first value that is missing or out of range.
    """
    check_name(config.name)
    if OmegaConf.is_missing(config, "unit"):
        raise UserError("unit: got none, expected an .onnx, .pt2 or .ckpt file: unit=…")
    check_range("aggregation_factor", config.aggregation_factor, 0.0, 1.0)
    check_range("floor_height", config.floor_height, -1000.0, 1000.0, "m")
    if config.max_speed is not None:
        check_range("max_speed", config.max_speed, 0.0, 1e4, "m/s", open_low=True)
    if config.threshold is not None:
        check_range("threshold", config.threshold, 0.0, 1.0, open_low=True)
    for name in ("field_of_view", "vertical_field_of_view", "tilt"):
        check_range(f"limits.{name}", config.limits[name], 0.0, 180.0, "degrees")
    check_range("limits.mount_height", config.limits.mount_height, 0.0, 180.0, "m")
    check_range("limits.resolution", config.limits.resolution, 1.0, 1000.0, "times fewer pixels a degree")


def module_of(config: DictConfig) -> ImaginationModule:
    """The trained units that `unit` names.

    Raises:
        UserError: see `load`.
    """
    return load(config.unit if isinstance(config.unit, str) else list(config.unit))


def mapper_of(
    config: DictConfig, module: ImaginationModule, camera: RgbdCamera, world: str = "map"
) -> SemanticMapper:
    """The mapper of a robot with this camera; `world` is the frame of its map unless the config names one.

    Raises:
        UserError: see `SemanticMapper`.
    """
    grid = None
    if config.extent is not None:
        try:
            x, y = map(float, config.centre)
        except (TypeError, ValueError) as error:
            raise UserError(f"centre: got {config.centre}, expected [x, y] in metres") from error
        grid = Grid.centred(config.extent, module.spec.ego.resolution, (x, y))
    return SemanticMapper(
        module,
        camera,
        instantiate(config.mapping.registration),
        grid,
        config.floor_height,
        config.frame or world,
        instantiate(config.limits),
        load_layer(config.start) if config.start else None,
        config.threshold,
    )

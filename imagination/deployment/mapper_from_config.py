"""Construction of a semantic mapper from conf/mapper.yaml."""

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.config.validation import check_name
from imagination.deployment.load import load
from imagination.geometry.grid import Grid
from imagination.geometry.rgbd import RgbdCamera
from imagination.mapping.map_io import load_layer
from imagination.mapping.predictor import MapPredictor
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.utils.errors import UserError, check_range


def validate(config: DictConfig) -> None:
    """Check the values of the config before any file is read.

    Raises:
        UserError: on the first value that is missing or out of range.
    """
    check_name(config.name)
    if OmegaConf.is_missing(config, "unit"):
        raise UserError("unit: got none, expected an .onnx, .pt2 or .ckpt file: unit=…")
    check_range("aggregation_factor", config.aggregation_factor, 0.0, 1.0)
    check_range("floor_height", config.floor_height, -1000.0, 1000.0, "m")
    if config.threshold is not None:
        check_range("threshold", config.threshold, 0.0, 1.0, open_low=True)


def predictor_of(config: DictConfig) -> MapPredictor:
    """Load the trained units of `unit`.

    Raises:
        UserError: see `load`.
    """
    return load(config.unit if isinstance(config.unit, str) else list(config.unit))


def mapper_of(
    config: DictConfig, predictor: MapPredictor, camera: RgbdCamera, world: str = "map"
) -> SemanticMapper:
    """Build the semantic mapper.

    Args:
        config: config of the command.
        predictor: trained units.
        camera: camera of the robot.
        world: frame of the map if the config has none.

    Raises:
        UserError: see `SemanticMapper`.
    """
    grid = None
    if config.extent is not None:
        try:
            x, y = map(float, config.centre)
        except (TypeError, ValueError) as error:
            raise UserError(f"centre: got {config.centre}, expected [x, y] in metres") from error
        grid = Grid.centred(config.extent, predictor.spec.ego.resolution, (x, y))
    return SemanticMapper(
        predictor,
        camera,
        instantiate(config.mapping.registration),
        grid,
        config.floor_height,
        config.frame or world,
        load_layer(config.start) if config.start else None,
        config.threshold,
    )

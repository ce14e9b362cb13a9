"""Small checkpoints of untrained units."""

from pathlib import Path

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.config.compose import compose
from imagination.deployment.export import Sample
from imagination.geometry.pose import Pose
from imagination.geometry.projection import project_depth
from imagination.mapping.predictor import Observation
from imagination.models.ego_metrics import THRESHOLDS
from imagination.runs.checkpoint import KEY, hyperparameters
from imagination.scenes.renderer import Renderer
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import CAMERA, EGO, Toy


def make_checkpoint(path: Path, *choices: str, threshold: float = 0.5) -> Path:
    """Write a checkpoint of an untrained unit in the format of training.

    Args:
        path: path of the file.
        choices: overrides of the config; the scale is `test` by default.
        threshold: threshold in place of one selected by a validation.
    """
    overrides = (
        [*choices] if any(choice.startswith("scale=") for choice in choices) else ["scale=test", *choices]
    )
    config = compose("train", [*overrides, "paths.run=."])
    OmegaConf.update(config, "choices", overrides)
    torch.manual_seed(0)
    model = instantiate(config.model.module)
    liven(model.unit, config)
    model.chosen.fill_(THRESHOLDS.index(threshold))
    spec = hyperparameters(config)
    torch.save({"state_dict": model.state_dict(), KEY: spec}, path)
    return path


def liven(unit: torch.nn.Module, config: DictConfig) -> None:
    """Scale the head of an untrained unit so that its predictions for random observations fall on both sides of 0.5."""
    generator = torch.Generator().manual_seed(0)
    size, cells = config.camera.width, instantiate(config.ego).cells
    maps = (torch.rand(4, 2, cells, cells, generator=generator) < 0.3).to(torch.uint8)
    depth = (6 * torch.rand(4, 1, size, size, generator=generator)).half()
    rgb = torch.randint(0, 256, (4, 3, size, size), dtype=torch.uint8, generator=generator)
    with torch.no_grad():
        unit.train()
        for _ in range(10):
            unit(rgb, depth, maps[:, :1], maps[:, 1:])
        logits = unit.eval()(rgb, depth, maps[:, :1], maps[:, 1:])
        scale = 2 / logits.std()
        unit.head.weight.mul_(scale)
        unit.head.bias.sub_(logits.mean()).mul_(scale)


def samples(count: int, categories: int = 1) -> list[Sample]:
    """Render samples in a room."""
    scene = tiny_room()
    renderer = Renderer(scene.mesh, scene.lighting)
    result = []
    for number in range(count):
        pose = Pose(0.5, -0.6 + 0.1 * number, 2.1 * number)
        image = renderer.render(CAMERA, CAMERA.to_world(pose))
        view = project_depth(image.depth, CAMERA, EGO, Toy().spec.obstacles)
        observation = Observation(image.rgb, image.depth, view.occupied, view.seen, CAMERA.mount_height)
        result.append(Sample(observation, np.zeros((categories, EGO.cells, EGO.cells), np.bool_)))
    return result

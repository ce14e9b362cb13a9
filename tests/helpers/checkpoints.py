"""Checkpoints of units that were never trained: small, and made in a moment."""

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
from imagination.runs.checkpoint import KEY, ConfigInCheckpoint
from imagination.scenes.renderer import Renderer
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import CAMERA, EGO, Toy


def make_checkpoint(path: Path, *choices: str, threshold: float = 0.5) -> Path:
    """A checkpoint as training would write it, of a unit that was never trained; at scale=test unless chosen.

    `threshold` stands for what a validation would have chosen.
    """
    every = [*choices] if any(choice.startswith("scale=") for choice in choices) else ["scale=test", *choices]
    config = compose("train", [*every, "paths.run=."])
    OmegaConf.update(config, "choices", every)
    torch.manual_seed(0)
    model = instantiate(config.model.module)
    liven(model.unit, config)
    model.chosen.fill_(THRESHOLDS.index(threshold))
    spec = ConfigInCheckpoint(config).spec
    torch.save({"state_dict": model.state_dict(), KEY: spec}, path)
    return path


def liven(unit: torch.nn.Module, config: DictConfig) -> None:
    """Give an untrained unit answers on both sides of one half, by the statistics of random observations."""
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
    """Real views of a room."""
    scene = tiny_room()
    renderer = Renderer(scene.mesh, scene.lighting)
    found = []
    for number in range(count):
        pose = Pose(0.5, -0.6 + 0.1 * number, 2.1 * number)
        image = renderer.render(CAMERA, CAMERA.to_world(pose))
        view = project_depth(image.depth, CAMERA, EGO, Toy().spec.obstacles)
        seen = Observation(image.rgb, image.depth, view.occupied, view.seen, CAMERA.mount_height)
        found.append(Sample(seen, np.zeros((categories, EGO.cells, EGO.cells), np.bool_)))
    return found

"""Checkpoints of units that were never trained: small, and made in a moment."""

from pathlib import Path

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from imagination.checkpoints import KEY, ConfigInCheckpoint
from imagination.config import compose
from imagination.deployment.export import Sample
from imagination.geometry.pose import Pose
from imagination.geometry.projection import project_depth
from imagination.mapping.module import Observation
from imagination.scenes.renderer import Renderer
from tests.modules import CAMERA, EGO, Toy
from tests.rooms import tiny_room


def make_checkpoint(path: Path, *choices: str) -> Path:
    """A checkpoint as training would write it, at scale=test unless chosen, with random weights and statistics."""
    every = [*choices] if any(choice.startswith("scale=") for choice in choices) else ["scale=test", *choices]
    config = compose("train", [*every, "paths.run=."])
    OmegaConf.update(config, "choices", every)
    torch.manual_seed(0)
    model = instantiate(config.model.module)
    with torch.no_grad():
        for part in model.modules():
            if isinstance(part, torch.nn.BatchNorm2d):
                part.running_mean.normal_(std=0.1)
                part.running_var.uniform_(0.2, 1.0)
                part.bias.normal_(std=0.3)
        model.unit.head.bias.zero_()  # answers on both sides of one half
        model.unit.head.weight.normal_()
    description = ConfigInCheckpoint(config).description
    torch.save({"state_dict": model.state_dict(), KEY: description}, path)
    return path


def samples(count: int, categories: int = 1) -> list[Sample]:
    """Real views of a room."""
    scene = tiny_room()
    renderer = Renderer(scene.mesh, scene.lighting)
    found = []
    for number in range(count):
        pose = Pose(0.5, -0.6 + 0.1 * number, 2.1 * number)
        image = renderer.render(CAMERA, CAMERA.to_world(pose))
        view = project_depth(image.depth, CAMERA, EGO, Toy().description.obstacles)
        seen = Observation(image.rgb, image.depth, view.occupied, view.seen, CAMERA.mount_height)
        found.append(Sample(seen, np.zeros((categories, EGO.cells, EGO.cells), np.bool_)))
    return found

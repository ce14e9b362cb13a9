"""Unit that imagines from the egocentric depth projection alone."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class BlindUnit(nn.Module):
    """Two convolutions over occupied and seen cells."""

    def __init__(self, width: int, categories: Sequence[str]) -> None:
        super().__init__()
        self.categories = list(categories)
        self.layers = nn.Sequential(
            nn.Conv2d(2, width, 5, padding=2), nn.ReLU(), nn.Conv2d(width, len(self.categories), 5, padding=2)
        )

    def forward(self, rgb: Tensor, depth: Tensor, occupied: Tensor, seen: Tensor) -> Tensor:
        logits: Tensor = self.layers(torch.cat([occupied, seen], dim=1).float())
        return logits

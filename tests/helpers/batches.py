"""Small random batches for the tests of units."""

import torch
from torch import Tensor


def random_batch(
    views: int = 2,
    size: int = 32,
    cells: int = 33,
    categories: int = 1,
    height: int | None = None,
    seed: int = 0,
) -> dict[str, Tensor]:
    """Return a random batch with the types and shapes of the data module's batches."""
    generator = torch.Generator().manual_seed(seed)

    def bits(channels: int, probability: float) -> Tensor:
        return (torch.rand(views, channels, cells, cells, generator=generator) < probability).to(torch.uint8)

    image = (height or size, size)
    label = bits(categories, 0.1)
    return {
        "rgb": torch.randint(0, 256, (views, 3, *image), dtype=torch.uint8, generator=generator),
        "depth": (5 * torch.rand(views, 1, *image, generator=generator)).half(),
        "occupied": bits(1, 0.2),
        "seen": bits(1, 0.6),
        "label": label,
        "neighbourhood": label | bits(categories, 0.2),
    }


def inputs(batch: dict[str, Tensor]) -> list[Tensor]:
    """Return the inputs of a unit, in order."""
    return [batch[name] for name in ("rgb", "depth", "occupied", "seen")]

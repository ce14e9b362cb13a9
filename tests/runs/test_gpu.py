"""Training and evaluation on a CUDA GPU."""

from pathlib import Path

import pytest
import torch

from imagination.runs.checkpoint import Checkpoint, read_state
from tests.conftest import Command
from tests.helpers.batches import random_batch
from tests.helpers.checkpoints import make_checkpoint

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")


@pytest.mark.slow
@pytest.mark.parametrize(
    "job",
    [
        ["+experiment=chair_unet"],
        ["+experiment=segmentation_hrnet"],
        ["+experiment=chair_unet", "model=projected"],
    ],
)
def test_the_same_seed_gives_the_same_weights_and_tables(
    command: Command, tmp_path: Path, job: list[str]
) -> None:
    states, tables = [], []
    for name in ("first", "second"):
        done = command("train", *job, "scale=test", f"paths.outputs={name}", "paths.cache=cache", timeout=600)
        assert done.returncode == 0, done.stderr
        assert "deterministic implementation" not in done.stderr
        run = next((tmp_path / name).glob("*/latest"))
        states.append(read_state(run / "checkpoints" / "last.ckpt")["state_dict"])
        tables.append([path.read_bytes() for path in sorted(run.glob("tables/*.csv"))])
    assert all(torch.equal(weights, states[1][key]) for key, weights in states[0].items())
    assert tables[0] == tables[1]


def test_a_gpu_and_the_cpu_agree(tmp_path: Path) -> None:
    """In single precision; convolutions on a GPU round the factors to 10 bits (TF32)."""
    checkpoint = Checkpoint.read(make_checkpoint(tmp_path / "chair.ckpt", "+experiment=chair_unet"))
    batch = random_batch(4, 48, 31)
    on_cpu, on_gpu = (checkpoint.model().to(device).predict(batch).maps.cpu() for device in ("cpu", "cuda"))
    assert on_cpu.std() > 0.05
    torch.testing.assert_close(on_gpu, on_cpu, atol=0.01, rtol=0)

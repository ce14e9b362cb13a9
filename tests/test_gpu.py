"""Training and evaluation where there is a CUDA GPU."""

import csv
import os
from pathlib import Path

import pytest
import torch

from imagination.checkpoints import read_state
from tests.conftest import Command

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU here")


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


def test_a_gpu_and_the_cpu_agree(command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = command("train", "+experiment=chair_unet", "scale=test", "scale.precision=32-true", timeout=600)
    assert done.returncode == 0, done.stderr
    tables = []
    for device in (os.environ.get("CUDA_VISIBLE_DEVICES", "0"), "-1"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", device)
        done = command(
            "evaluate", "ckpt=outputs/chair_unet/latest/checkpoints/best.ckpt", "paths.cache=cache" + device
        )
        assert done.returncode == 0, done.stderr
        folder = max(tmp_path.glob("outputs/chair_unet/evaluate_*"), key=os.path.getmtime)
        tables.append(list(csv.DictReader((folder / "tables" / "mapping.csv").read_text().splitlines())))
    for on_gpu, on_cpu in zip(*tables, strict=True):
        assert float(on_gpu["iou_pooled"]) == pytest.approx(float(on_cpu["iou_pooled"]), abs=0.01)

"""Rows on the training of networks."""

from pathlib import Path
from typing import Any

from imagination.evaluation.networks import network_rows
from imagination.reporting import tables
from imagination.runs.checkpoint import KEY, CheckpointFiles
from imagination.runs.checkpoint import Checkpoint as Read


def checkpoint(
    path: Path, name: str, predicts: str, categories: list[str], callbacks: dict[str, Any]
) -> Read:
    values = {"name": name, "unit_categories": categories, "model": {"predicts": predicts}}
    state = {KEY: {"choices": [], "values": values}, "state_dict": {}, "callbacks": callbacks}
    CheckpointFiles().save_checkpoint(state, path)
    return Read.read(path)


def counts(epochs: int) -> dict[str, Any]:
    return {"epochs": epochs, "samples": 640 * epochs, "views": 900, "seconds": 30.0 * epochs, "best": 0.625}


def test_every_network_has_its_training_statistics(tmp_path: Path) -> None:
    network = tmp_path / "network"
    checkpoint(network / "last.ckpt", "hrnet", "images", ["chair", "bed"], {
        "TrainingStats": counts(9),
        "EarlyStopping{'monitor': 'val/iou', 'mode': 'max'}": {"wait_count": 3, "patience": 3},
    })  # fmt: skip
    best = checkpoint(
        network / "best.ckpt", "hrnet", "images", ["chair", "bed"], {"TrainingStats": counts(5)}
    )
    unit = checkpoint(tmp_path / "best.ckpt", "chair_unet", "maps", ["chair"], {"TrainingStats": counts(4)})
    old = checkpoint(tmp_path / "old.ckpt", "chair_unet", "maps", ["chair"], {})
    rows = tables.networks(network_rows([unit, best, old], ["chair"]), {"chair": 0.5})
    assert [(row["network"], row["category"], row["epochs"]) for row in rows] == [
        ("chair_unet", "chair", "4"), ("hrnet", "chair", "9"), ("chair_unet", "chair", ""),
    ]  # fmt: skip
    assert [row["until"] for row in rows] == ["last epoch", "flat", ""]
    assert [row["iou_first_person"] for row in rows] == ["", "0.5000", ""]
    public = tables.networks(network_rows([unit], ["chair"], public=True), {"chair": 0.5})[1]
    assert list(public) == list(rows[0])
    assert {name: value for name, value in public.items() if value} == {
        "network": "ade20k", "category": "chair", "iou_first_person": "0.5000",
    }  # fmt: skip
    whole = rows[1]  # of the whole run, not up to its best epoch
    assert (whole["samples"], whole["minutes"], whole["iou_val_views"]) == ("5760", "4.5", "0.6250")

"""Hand-made results folders of an evaluation of small random maps."""

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from imagination.evaluation import record_files, saved_maps, single_views
from imagination.evaluation.saved_maps import SavedMaps
from imagination.evaluation.single_views import CELLS, SingleView, SingleViews
from imagination.evaluation.trials import Trial
from imagination.geometry.grid import Grid

APPROACHES = ["seg_gt", "imagination_seen", "imagination", "mine"]
CATEGORIES = ["chair", "bed"]
WIDTHS = [3.0, 2.0]
SCENES = [f"test_{number:04d}" for number in range(6)]
WITHOUT_BED = SCENES[-1]
SETS = 2


def make_config(**changes: Any) -> dict[str, Any]:
    config = {
        "name": "made",
        "seed": 7,
        "unit_categories": CATEGORIES,
        "ego": {"resolution": 0.1},
        "data": {"scenes": {"_target_": "tests.sources.Rooms"}},
        "evaluation": {
            "approaches": {name: {} for name in APPROACHES},
            "cell_widths": WIDTHS,
            "viewpoint_sets": SETS,
            "seed": 0,
            "resamples": 200,
        },
        "choices": ["+experiment=made", "seed=7"],
    }
    return {**config, **changes}


def make_maps(trial: Trial, rng: np.random.Generator) -> SavedMaps:
    """Return maps whose ground truth is a block that every approach scores higher than the rest."""
    shape = (len(CATEGORIES), 30, 40)
    gt = np.zeros(shape, bool)
    gt[:, 5:12, 6:16] = True
    level = np.stack([rng.integers(0, 70, shape) + 10 * (at + 1) * gt for at in range(len(APPROACHES))])
    level = np.where(rng.random(level.shape) < 0.6, 0, level).clip(0, 99)
    threshold = np.arange(30, 30 + len(APPROACHES) * len(CATEGORIES), dtype=np.uint8)
    present = np.array([True, trial.scene != WITHOUT_BED])
    seen = np.ones(shape[1:], bool)
    return SavedMaps(
        trial, APPROACHES, CATEGORIES, level.astype(np.uint8), threshold.reshape(-1, len(CATEGORIES)),
        gt & present[:, None, None], present, seen, gt.any(axis=0),
        np.array([[0.5, 0.5, 0.3], [0.5, 0.5, 2.0], [2.0, 1.5, 1.0]]), Grid(0.1, 30, 40, (-1.0, -1.0)),
    )  # fmt: skip


def make_single_views(rng: np.random.Generator) -> SingleViews:
    """Return single views with random images and falling counts."""
    label = np.zeros((21, 21), bool)
    label[4:9, 4:9] = True
    shown = [
        SingleView(
            rank, category, "test_0000", np.zeros(3), 0.5, rng.integers(0, 255, (16, 16, 3), np.uint8), label, label,
            label, rng.random((21, 21), np.float32), {name: label for name in APPROACHES},
        )
        for category in CATEGORIES
        for rank in single_views.RANKS
    ]  # fmt: skip
    falling = np.stack([np.arange(99, 0, -1), 2 * np.arange(99, 0, -1), np.full(99, 150)], axis=-1)
    counts = {key: falling for key in product(APPROACHES, CATEGORIES)}
    return SingleViews(shown, counts, {key: falling for key in product(CELLS, CATEGORIES)}, 12, 0.1)


def make_about(seed: int) -> dict[str, Any]:
    """Return the content of records/evaluation.json."""
    return {
        "version": record_files.VERSION,
        "seed": seed,
        "resolution": 0.1,
        "sensor": "16 x 16 pixels",
        "precision": "32-true",
        "protocol": {
            "cell_widths": WIDTHS,
            "viewpoint_sets": SETS,
            "orientations": 3,
            "seed": 0,
            "resamples": 200,
        },
        "approaches": {name: {"rule": "Max()", "postprocess": "none"} for name in APPROACHES},
        "selected": [
            {"approach": approach, "category": category, "threshold": 0.3, "kernel": 0.0, "iou": 0.25}
            for approach, category in product(APPROACHES, CATEGORIES)
        ],
        "scenes": {"chair": len(SCENES), "bed": len(SCENES) - 1},
        "left_out": {"chair": 0, "bed": 1},
        "viewpoints": {
            "sets": SETS * len(SCENES) * len(WIDTHS),
            "empty": 0,
            "viewpoints": 40,
            "moved": 0.125,
        },
        "first_person": {},
        "networks": [],
        "credits": [],
        "seconds": 12.25,
        "provenance": {
            "date": "2026-11-30T12:00:00+00:00",
            "version": "0.1.0",
            "commit": "0123456789abcdef",
            "command": "python -m imagination.train +experiment=made",
            "processor": "a processor, 2 cores",
        },
        "folder": "/outputs/made/2026-11-30_12-00-00",
    }


def make_folder(folder: Path, drawn: int = 0, **changes: Any) -> Path:
    """Write config, maps, records counted by plain loops, and single views."""
    rng = np.random.default_rng(drawn)
    (folder / "records").mkdir(parents=True)
    (folder / "tables").mkdir()
    config = make_config(**changes)
    (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    lines = [",".join(record_files.COLUMNS)]
    rows: dict[tuple[str, str, float], list[str]] = {
        key: [] for key in product(APPROACHES, CATEGORIES, WIDTHS)
    }
    for scene, width, number in product(SCENES, WIDTHS, range(SETS)):
        maps = make_maps(Trial(scene, width, number), rng)
        saved_maps.save(folder, maps)
        for place, approach in enumerate(APPROACHES):
            for layer, category in enumerate(CATEGORIES):
                if not maps.present[layer]:
                    continue
                predicted = maps.level[place, layer] >= maps.threshold[place, layer]
                gt = maps.truth[layer]
                correct, false = int((predicted & gt).sum()), int((predicted & ~gt).sum())
                counts = f"{correct},{false},{int(gt.sum())}"
                rows[approach, category, width].append(
                    f"test,{approach},{category},{width:g},{scene},{number},{counts},{counts},{counts}"
                )
    lines += [line for group in rows.values() for line in group]
    (folder / "records" / "trials.csv").write_text("\n".join(lines) + "\n")
    seed = config["seed"] if isinstance(config["seed"], int) else 0
    write_about(folder, make_about(seed))
    single_views.write(folder, make_single_views(rng))
    return folder


def read_about(folder: Path) -> dict[str, Any]:
    """Return the content of records/evaluation.json."""
    about: dict[str, Any] = json.loads((folder / "records" / "evaluation.json").read_text())
    return about


def write_about(folder: Path, about: dict[str, Any]) -> None:
    """Write records/evaluation.json."""
    (folder / "records" / "evaluation.json").write_text(json.dumps(about))


def set_command(folder: Path, command: str) -> None:
    """Change the command in the records."""
    about = read_about(folder)
    write_about(folder, {**about, "provenance": {**about["provenance"], "command": command}})

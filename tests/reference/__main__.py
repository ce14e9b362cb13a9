"""Write the reference: `python -m tests.reference` (some minutes)."""

import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.reference.results import (
    EXPERIMENTS,
    FOLDER,
    OVERRIDES,
    SCENES,
    integer_maps,
    make_observer,
    pose_hashes,
    scene_hashes,
    table,
)


def main() -> None:
    """Compute scenes, poses, maps and the tables of all experiments, and write them."""
    with TemporaryDirectory() as scratch:
        observer = make_observer(Path(scratch) / "cache")
        scenes = {name: scene_hashes(observer.scene(name)) for name in SCENES}
        poses = {name: pose_hashes(observer, name) for name in SCENES}
        maps = {name: np.packbits(values) for name, values in integer_maps(observer)}
        shapes = {name: list(values.shape) for name, values in integer_maps(observer)}
        tables = {}
        for experiment in EXPERIMENTS:
            outputs = Path(scratch) / experiment
            words = [f"+experiment={experiment}", *OVERRIDES, f"paths.outputs={outputs}"]
            subprocess.run([sys.executable, "-m", "imagination.train", *words], check=True)
            tables[experiment] = table(next(outputs.glob("*/latest/tables/mapping.csv")))
    content = {"scenes": scenes, "poses": poses, "map_shapes": shapes, "tables": tables}
    (FOLDER / "reference.json").write_text(json.dumps(content, indent=1) + "\n")
    np.savez_compressed(FOLDER / "maps.npz", **maps)


if __name__ == "__main__":
    main()

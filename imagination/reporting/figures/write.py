"""Writer of the figures of an evaluation."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from imagination.evaluation import saved_maps
from imagination.evaluation.records import Example
from imagination.evaluation.trials import Trial
from imagination.reporting import style
from imagination.reporting.figures.file_names import safe_names
from imagination.reporting.figures.maps import draw_maps, save
from imagination.reporting.figures.scores import draw_iou
from imagination.reporting.load_run import Results
from imagination.utils.tabular import Row


def write_figures(folder: Path, results: Results, rows: Sequence[Row]) -> None:
    """Write first_scene_<category>.png and iou.png into `folder`, each atomically.

    Args:
        folder: folder of the figures.
        results: results with saved maps.
        rows: rows of mapping.csv.
    """
    names = safe_names([f"first_scene_{category}" for category in results.categories])
    with style.theme("light"):
        for category in results.categories:
            if examples := list(examples_of(results, category)):
                save(draw_maps(examples), folder / f"{names[f'first_scene_{category}']}.png")
        save(draw_iou(rows), folder / "iou.png")


def examples_of(results: Results, category: str) -> Iterator[Example]:
    """Yield the maps of the first viewpoint set of the category's first scene, one for each cell width."""
    trials = results.trials[results.trials["category"] == category]
    folder = results.parts[0].folder
    for width in trials["cell_width"].unique().tolist():
        path = saved_maps.path_of(folder, Trial(trials["scene"].iloc[0], width, 0))
        if path.is_file():
            maps = saved_maps.load(path)
            yield maps.example(maps.categories.index(category))

"""Writer of the figures of an evaluation."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from imagination.evaluation.records import Example, Report
from imagination.reporting import style
from imagination.reporting.figures.maps import draw_maps, save
from imagination.reporting.figures.scores import draw_iou
from imagination.utils.tabular import Row


def write_figures(folder: Path, report: Report, rows: Sequence[Row]) -> None:
    """Write maps_<category>.png and iou.png into `folder`, each atomically."""
    by_category: dict[str, list[Example]] = defaultdict(list)
    for example in report.examples:
        by_category[example.category].append(example)
    with style.theme("light"):
        for category, examples in by_category.items():
            save(draw_maps(examples), folder / f"maps_{category}.png")
        save(draw_iou(rows), folder / "iou.png")

"""End of a sweep: its table and best setting in the terminal, and its report in the folder of the sweep."""

import sys
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from imagination.utils.errors import UserError


class SweepReport(Callback):
    """Hydra callback that prints the results of a sweep and writes its report, if at least one job was evaluated."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        from imagination.evaluation.record_files import ABOUT, FOLDER  # slow import

        folder = Path(config.hydra.sweep.dir)
        if any(folder.glob(f"*/{FOLDER}/{ABOUT}")):
            try:
                print(f"Report: {write(folder)}", file=sys.stderr)
            except UserError as error:  # the jobs themselves have succeeded
                print(f"error: no report on {folder}: {error}", file=sys.stderr)


def write(folder: Path) -> Path:
    """Print the table and the best setting of a sweep; write its report and return the path of the page.

    Raises:
        UserError: if no job was evaluated, or the report cannot be written.
    """
    # slow imports, which sweeps without an evaluation do not need
    from rich.console import Console

    from imagination.evaluation.single_views import ranked_by
    from imagination.reporting import ablation, best_setting, html
    from imagination.reporting.load_sweep import Multirun
    from imagination.reporting.style import label
    from imagination.reporting.tables import SCREEN_MAPPING, SCREEN_SWEEP, to_screen

    sweep = Multirun(folder)
    rows = ablation.setting_tables(sweep)["mapping"]
    approach = ranked_by(list(dict.fromkeys(row["approach"] for row in rows)))
    shown = [row for row in rows if row["approach"] == approach or len(sweep.settings) == 1]
    swept = [key for setting in sweep.settings[:1] for key in setting.values]
    title = "Sweep" if len(sweep.settings) == 1 else f"Sweep, {label(approach)}"
    columns = SCREEN_MAPPING if len(sweep.settings) == 1 else SCREEN_SWEEP
    Console().print(to_screen(shown, title, [*swept, *columns]))
    content = ablation.of_multirun(sweep)
    for line in [*(f"incomplete: {problem}" for problem in content.problems), *best_setting.summary(sweep)]:
        print(line, file=sys.stderr)
    return html.write(folder, content)

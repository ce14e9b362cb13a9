"""Writer of an evaluation's tables and figures into a folder, and of its main tables to the terminal."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from imagination.evaluation.run import Evaluation
from imagination.reporting import credits, mapping_report
from imagination.reporting.figures.write import write_figures
from imagination.reporting.tables import SCREEN_MAPPING, SCREEN_PAIRED, mapping_rows, paired_rows, to_screen
from imagination.utils.hardware import command_line, hardware
from imagination.utils.precision import resolved
from imagination.utils.tabular import Row


def write_results(folder: Path, evaluation: Evaluation, training: Sequence[Row] = ()) -> list[Row]:
    """Write tables/ and figures/, print the main tables and return the rows of mapping.csv.

    Args:
        folder: folder of the results.
        evaluation: records of the evaluation.
        training: rows on the training of the networks, for training.csv.

    Raises:
        UserError: if the disk is full or the folder cannot be written.
    """
    protocol, setting, report = evaluation.protocol, evaluation.setting, evaluation.report
    resolution = setting.ego.resolution
    origin = mapping_report.Provenance(
        command_line(),
        evaluation.seed,
        f"{hardware()}, networks in {resolved(protocol.precision)}",
        evaluation.seconds,
        mapping_report.declared_sensor(setting, protocol.approaches),
    )
    further = mapping_report.FurtherTables(training, evaluation.known)
    mapping_report.write_tables(folder / "tables", report, protocol, resolution, origin, further)
    credits.write(folder / "tables", evaluation.credits)
    rows = mapping_rows(report, protocol, resolution)
    write_figures(folder / "figures", report, rows)
    screen = Console()
    screen.print(to_screen(rows, "Global maps", SCREEN_MAPPING))
    if paired := paired_rows(report, protocol):
        screen.print(to_screen(paired, "Paired differences", SCREEN_PAIRED))
    return rows

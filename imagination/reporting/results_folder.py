"""Writer of an evaluation's tables and figures from its records, and of its main tables to the terminal."""

from pathlib import Path

from rich.console import Console

from imagination.reporting import mapping_report
from imagination.reporting.figures.write import write_figures
from imagination.reporting.load_run import Results
from imagination.reporting.tables import SCREEN_MAPPING, SCREEN_PAIRED, to_screen
from imagination.utils.atomic_io import write_text
from imagination.utils.tabular import Row


def write_results(folder: Path) -> list[Row]:
    """Write tables/ and figures/ of an evaluation, print the main tables and return the rows of mapping.csv.

    Args:
        folder: folder of the results, which contains the records.

    Raises:
        UserError: if the records are missing or damaged, the disk is full or the folder cannot be written.
    """
    results = Results(folder)
    results.check_records()
    for name, text in mapping_report.table_files(results).items():
        write_text(folder / "tables" / name, text)
    rows = mapping_report.main_tables(results)
    write_figures(folder / "figures", results, rows["mapping"])
    screen = Console()
    screen.print(to_screen(rows["mapping"], "Global maps", SCREEN_MAPPING))
    if rows["paired"]:
        screen.print(to_screen(rows["paired"], "Paired differences", SCREEN_PAIRED))
    return rows["mapping"]

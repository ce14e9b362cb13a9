"""Report on a run, an evaluation, a study or a sweep: `python -m imagination.report outputs/chair_unet/latest`.

Writes report.html into its folder, one page that needs no network, with tables/ (CSV, Markdown, LaTeX) and figures/
(PNG, PDF). `--docs docs/study` writes a page of Markdown, docs/study.md, with its figures in docs/study/ instead.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from imagination.config.user_messages import user_errors_reported
from imagination.utils.errors import UserError

if TYPE_CHECKING:  # with it comes matplotlib, which --help does without
    from imagination.reporting.content import Content


def main(arguments: list[str]) -> None:
    """The command."""
    parser = argparse.ArgumentParser("python -m imagination.report", description=__doc__.partition("\n")[0])
    # arguments as other programs take them: there is no config to compose here
    parser.add_argument("folder", type=Path, help="of a run, an evaluation, a study or a sweep")
    parser.add_argument(
        "--docs", type=Path, metavar="PAGE", help="write PAGE.md and figures into PAGE/ instead"
    )
    given = parser.parse_args(arguments)
    from imagination.reporting import html, markdown

    content = read(given.folder)
    written = markdown.write(given.docs, content) if given.docs else html.write(given.folder, content)
    for problem in content.problems:
        print(f"incomplete: {problem}", file=sys.stderr)
    print(f"Report: {written}", file=sys.stderr)


def read(folder: Path) -> Content:
    """What there is to report on in a folder.

    Raises:
        UserError: if it is no run's, evaluation's, study's or sweep's.
    """
    from imagination.reporting.ablation import of_multirun
    from imagination.reporting.content import of_run
    from imagination.reporting.load_run import Results
    from imagination.reporting.load_sweep import Multirun, is_multirun
    from imagination.runs.folder import CONFIG

    if not folder.is_dir():
        raise UserError(
            f"report: got {folder}, but there is no such folder; such as outputs/chair_unet/latest"
        )
    if not (folder / CONFIG).is_file() and is_multirun(folder):
        return of_multirun(Multirun(folder))
    return of_run(Results(folder))


if __name__ == "__main__":
    with user_errors_reported():
        main(sys.argv[1:])

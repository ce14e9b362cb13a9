"""Report on a run, an evaluation, a study or a sweep: `python -m imagination.report outputs/chair_unet/latest`.

Writes a self-contained page report.html into the folder, with tables/ (CSV, Markdown, LaTeX) and figures/ (PNG, PDF).
`--docs docs/study` writes a Markdown page docs/study.md with figures in docs/study/ instead.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from imagination.config.user_messages import user_errors_reported
from imagination.utils.errors import UserError

if TYPE_CHECKING:  # imports matplotlib, which --help does not need
    from imagination.reporting.content import Content


def main(arguments: list[str]) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser("python -m imagination.report", description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of a run, an evaluation, a study or a sweep")
    parser.add_argument(
        "--docs", type=Path, metavar="PAGE", help="write PAGE.md with figures in PAGE/ instead"
    )
    options = parser.parse_args(arguments)
    from imagination.reporting import html, markdown

    content = read(options.folder)
    page = markdown.write(options.docs, content) if options.docs else html.write(options.folder, content)
    for problem in content.problems:
        print(f"incomplete: {problem}", file=sys.stderr)
    print(f"Report: {page}", file=sys.stderr)


def read(folder: Path) -> Content:
    """Read the content of a report from a results folder.

    Raises:
        UserError: if the folder is not that of a run, an evaluation, a study or a sweep.
    """
    from imagination.reporting.ablation import of_multirun
    from imagination.reporting.content import of_run
    from imagination.reporting.load_run import Results
    from imagination.reporting.load_sweep import Multirun, is_multirun
    from imagination.runs.folder import CONFIG

    if not folder.is_dir():
        raise UserError(
            f"report: got {folder}, expected an existing results folder such as outputs/chair_unet/latest"
        )
    if not (folder / CONFIG).is_file() and is_multirun(folder):
        return of_multirun(Multirun(folder))
    return of_run(Results(folder))


if __name__ == "__main__":
    with user_errors_reported():
        main(sys.argv[1:])

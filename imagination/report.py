"""Report on a run, an evaluation, a study or a sweep: `python -m imagination.report folder=outputs/chair_unet/latest`.

Writes a self-contained page report.html into the folder, with tables/ (CSV, Markdown, LaTeX) and figures/ (PNG, PDF).
`docs=docs/study` writes a Markdown page docs/study.md with figures in docs/study/ instead.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from imagination.runs.command import command
from imagination.utils.errors import UserError

if TYPE_CHECKING:  # imports matplotlib, which --help does not need
    from imagination.reporting.content import Content


def validate(config: DictConfig) -> None:
    """Check that the config names a folder.

    Raises:
        UserError: if it does not.
    """
    if OmegaConf.is_missing(config, "folder") or not config.folder:
        raise UserError(
            "folder: got none, expected the results of a run, an evaluation, a study or a sweep: "
            "folder=outputs/chair_unet/latest"
        )


@command("report", validate)
def main(config: DictConfig) -> None:
    """Write the report."""
    write(Path(str(config.folder)), None if config.docs is None else Path(str(config.docs)))


def write(folder: Path, docs: Path | None = None) -> None:
    """Write the report on a results folder into that folder, or as a page of the documentation."""
    from imagination.reporting import html, markdown

    content = read(folder)
    page = markdown.write(docs, content) if docs else html.write(folder, content)
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
            f"folder: got {folder}, expected an existing results folder such as outputs/chair_unet/latest"
        )
    if not (folder / CONFIG).is_file() and is_multirun(folder):
        return of_multirun(Multirun(folder))
    return of_run(Results(folder))


if __name__ == "__main__":
    main()

"""Report on a run, an evaluation, a study or a sweep: `python -m imagination.report folder=outputs/chair_unet/latest`.

Writes a self-contained page report.html into the folder, with tables/ (CSV, Markdown, LaTeX) and figures/ (PNG, PDF).
`output=my_report` writes them into another folder, for example if the run belongs to another user.
`docs=docs/results/study` writes a Markdown page docs/results/study.md, with its tables (CSV) and figures in
docs/results/study/, instead.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from imagination.runs.command import command
from imagination.utils.errors import CannotWriteError, UserError

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
    for key in ("docs", "output"):
        value = config[key]
        if value is None:
            continue
        if not str(value).strip() or (key == "docs" and Path(str(value)).name in ("", "..")):
            raise UserError(f"{key}: got {value!r}, expected the name of a folder, such as {key}=my_report")
        with access_reported(key, value):
            is_file = Path(str(value)).is_file()
        if is_file or Path(str(value)).suffix == ".md":
            raise UserError(f"{key}: got {value}, expected a folder; leave the file name out")
    if config.docs is not None and config.output is not None:
        raise UserError(
            f"output: got {config.output} and docs={config.docs}, expected one of them; leave one out"
        )


@command("report", validate)
def main(config: DictConfig) -> None:
    """Write the report."""
    docs, output = (None if value is None else Path(str(value)) for value in (config.docs, config.output))
    write(Path(str(config.folder)), docs, output)


def write(folder: Path, docs: Path | None = None, output: Path | None = None) -> None:
    """Write the report on a results folder into that folder or another one, or as a page of the documentation."""
    from imagination.reporting import html, markdown

    with access_reported("folder", folder):
        content = read(folder)
    try:
        page = markdown.write(docs, content) if docs else html.write(output or folder, content)
    except CannotWriteError as error:
        raise UserError(
            f"{error.__cause__}; write the report into another folder with {'docs' if docs else 'output'}=…"
        ) from error
    for problem in content.problems:
        print(f"incomplete: {problem}", file=sys.stderr)
    print(f"Report: {page}", file=sys.stderr)


@contextmanager
def access_reported(key: str, value: object) -> Iterator[None]:
    """Report a path that cannot be accessed, e.g. without permission or with a name that is too long.

    Raises:
        UserError: with the key and the path.
    """
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{key}: got {value}, which cannot be accessed ({error.strerror or error}); choose another folder"
        ) from error


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

"""A report as one HTML page that needs nothing else, and its tables and figures as files."""

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import matplotlib as mpl
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from imagination.reporting import paper_layout
from imagination.reporting.content import Content, Drawing
from imagination.reporting.figures.maps import save
from imagination.reporting.style import THEMES, theme
from imagination.utils.atomic_io import write_text

PAGE = "report.html"
"""In the folder that is reported on."""

DPI = 120
"""Of figures in the page."""


def write(folder: Path, content: Content) -> Path:
    """Write report.html, and its tables (CSV, Markdown, LaTeX) and figures (PNG, PDF) beside it.

    Raises:
        UserError: if the disk is full or may not be written.
    """
    write_tables(folder / "tables", content)
    write_figures(folder / "figures", content)
    page = folder / PAGE
    write_text(page, html(content))
    return page


def write_tables(folder: Path, content: Content) -> None:
    """Each table in the paper's layout as CSV, Markdown and LaTeX."""
    for section in content.sections:
        for table in section.layouts:
            write_text(folder / f"{table.stem}.csv", paper_layout.to_csv(table))
            write_text(folder / f"{table.stem}.md", paper_layout.to_markdown(table))
            write_text(folder / f"{table.stem}.tex", paper_layout.to_latex(table))


def write_figures(folder: Path, content: Content, kinds: tuple[str, ...] = ("png", "pdf")) -> None:
    """Each figure as files, for a light page."""
    for drawing in drawings(content):
        with themed("light"):
            figure = drawing.draw()
            for kind in kinds:
                save(figure, folder / f"{drawing.file}.{kind}")


def drawings(content: Content) -> Iterator[Drawing]:
    """All figures of a report."""
    return (drawing for section in content.sections for drawing in section.drawings)


def html(content: Content) -> str:
    """The page: pictures inside it, nothing loaded, no scripts; all text escaped."""
    return environment().get_template("page.html.j2").render(content=content, picture=picture, colours=THEMES)


def environment() -> Environment:
    """Templates of this package; text is escaped in those of pages."""
    loader = PackageLoader("imagination.reporting", "templates")
    return Environment(
        loader=loader,
        autoescape=lambda name: bool(name and name.endswith(".html.j2")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def picture(drawing: Drawing) -> Markup:
    """A figure in both themes, as an element of the page."""
    found = {}
    for name in THEMES:
        figure, content = png(drawing, name, DPI)
        found[name] = f"data:image/png;base64,{base64.b64encode(content).decode()}"
        width, height = (figure.get_size_inches() * 96).round().astype(int).tolist()
    return Markup(  # Markup escapes what it formats
        '<picture><source media="(prefers-color-scheme: dark)" srcset="{}">'
        '<img src="{}" alt="{}" width="{}" height="{}"></picture>'
    ).format(found["dark"], found["light"], drawing.caption, width, height)


def png(drawing: Drawing, theme: str, dpi: int) -> tuple[Figure, bytes]:
    """A figure, and its picture as PNG."""
    file = BytesIO()
    with themed(theme):
        figure = drawing.draw()
        FigureCanvasAgg(figure)
        figure.savefig(file, format="png", dpi=dpi, metadata={"Software": None})
    return figure, file.getvalue()


@contextmanager
def themed(name: str) -> Iterator[None]:
    """Draw and save figures for a light or a dark page; names from tables are text, whatever signs they hold."""
    with theme(name), mpl.rc_context({"text.parse_math": False}):
        yield

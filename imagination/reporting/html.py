"""Report as one self-contained HTML page, and its tables and figures as files."""

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
from imagination.reporting.figures.file_names import safe_names
from imagination.reporting.figures.maps import save
from imagination.reporting.style import THEMES, theme
from imagination.utils.atomic_io import write_text

PAGE = "report.html"
"""File name of the page in the folder of the run or sweep."""

DPI = 120
"""Resolution of figures in the page, dots per inch."""


def write(folder: Path, content: Content) -> Path:
    """Write report.html, the tables (CSV, Markdown, LaTeX) in tables/ and the figures (PNG, PDF) in figures/.

    Raises:
        UserError: if the disk is full or the folder cannot be written.
    """
    write_tables(folder / "tables", content)
    write_figures(folder / "figures", content)
    page = folder / PAGE
    write_text(page, html(content))
    return page


def write_tables(folder: Path, content: Content) -> None:
    """Write the tables, and each table in the paper's layout as CSV, Markdown and LaTeX."""
    for name, text in content.tables.items():
        write_text(folder / name, text)
    for section in content.sections:
        for table in section.layouts:
            write_text(folder / f"{table.stem}.csv", paper_layout.to_csv(table))
            write_text(folder / f"{table.stem}.md", paper_layout.to_markdown(table))
            write_text(folder / f"{table.stem}.tex", paper_layout.to_latex(table))


def write_figures(folder: Path, content: Content, kinds: tuple[str, ...] = ("png", "pdf")) -> None:
    """Write each figure in the light theme."""
    names = file_names(content)
    for drawing in drawings(content):
        with themed("light"):
            figure = drawing.draw()
            for kind in kinds:
                save(figure, folder / f"{names[drawing.stem]}.{kind}")


def drawings(content: Content) -> Iterator[Drawing]:
    """Return all figures of a report."""
    return (drawing for section in content.sections for drawing in section.drawings)


def file_names(content: Content) -> dict[str, str]:
    """Return the file name without suffix of each figure by its stem."""
    return safe_names(drawing.stem for drawing in drawings(content))


def html(content: Content) -> str:
    """Render the page: embedded figures, no external resources, no scripts, all text escaped."""
    template = environment().get_template("page.html.j2")
    return template.render(content=content, picture=picture, colours=THEMES, names=file_names(content))


def environment() -> Environment:
    """Return the Jinja environment of this package's templates; HTML templates escape text."""
    loader = PackageLoader("imagination.reporting", "templates")
    return Environment(
        loader=loader,
        autoescape=lambda name: bool(name and name.endswith(".html.j2")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def picture(drawing: Drawing) -> Markup:
    """Return a figure in both themes as an HTML element."""
    sources = {}
    for name in THEMES:
        figure, content = png(drawing, name, DPI)
        sources[name] = f"data:image/png;base64,{base64.b64encode(content).decode()}"
        width, height = (figure.get_size_inches() * 96).round().astype(int).tolist()
    return Markup(  # Markup.format escapes its arguments
        '<picture><source media="(prefers-color-scheme: dark)" srcset="{}">'
        '<img src="{}" alt="{}" width="{}" height="{}"></picture>'
    ).format(sources["dark"], sources["light"], drawing.caption, width, height)


def png(drawing: Drawing, theme: str, dpi: int) -> tuple[Figure, bytes]:
    """Draw a figure; return it and its PNG image."""
    file = BytesIO()
    with themed(theme):
        figure = drawing.draw()
        FigureCanvasAgg(figure)
        figure.savefig(file, format="png", dpi=dpi, metadata={"Software": None})
    return figure, file.getvalue()


@contextmanager
def themed(name: str) -> Iterator[None]:
    """Apply the light or dark theme to figures, without math in their text: names from tables are plain text."""
    with theme(name), mpl.rc_context({"text.parse_math": False}):
        yield

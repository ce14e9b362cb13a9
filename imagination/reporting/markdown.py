"""Report as a Markdown page for the documentation, with its tables and figures in a folder of the same name."""

from pathlib import Path

from imagination.reporting import html
from imagination.reporting.content import Content
from imagination.reporting.paper_layout import to_markdown
from imagination.utils import tabular
from imagination.utils.atomic_io import write_text
from imagination.utils.tabular import Row


def write(stem: Path, content: Content) -> Path:
    """Write `stem`.md, and the tables as CSV and the figures as PNG into `stem`/.

    Raises:
        UserError: if the disk is full or the folder cannot be written.
    """
    html.write_figures(stem, content, kinds=("png",))
    for name, text in content.tables.items():
        if name.endswith(".csv"):
            write_text(stem / name, text)
    environment = html.environment()
    environment.filters |= {
        "markdown": tabular.markdown_text,
        "code": tabular.markdown_code,
        "one_line": lambda text: " ".join(text.split()),
    }
    text = environment.get_template("page.md.j2").render(
        content=content,
        stem=stem,
        folder=stem.name,
        names=html.file_names(content),
        table=to_markdown,
        rows=_rows,
    )
    path = stem.with_name(f"{stem.name}.md")
    write_text(path, text)
    return path


def _rows(rows: list[Row]) -> str:
    """Return all columns of a table as Markdown."""
    return tabular.to_markdown(rows, list(rows[0]))

"""Report as a Markdown page for the documentation, with its figures in a folder of the same name."""

from pathlib import Path

from imagination.reporting import html
from imagination.reporting.content import Content
from imagination.reporting.paper_layout import to_markdown
from imagination.utils.atomic_io import write_text


def write(stem: Path, content: Content) -> Path:
    """Write `stem`.md, and the figures as PNG into `stem`/.

    Raises:
        UserError: if the disk is full or the folder cannot be written.
    """
    html.write_figures(stem, content, kinds=("png",))
    text = (
        html.environment()
        .get_template("page.md.j2")
        .render(content=content, folder=stem.name, table=to_markdown)
    )
    path = stem.with_name(f"{stem.name}.md")
    write_text(path, text)
    return path

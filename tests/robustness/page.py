"""Parts of docs/reliability.md that commands write, between marks."""

from datetime import date
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reliability.md"


def write_part(name: str, text: str) -> None:
    """Put the text between the marks of that name, with the day."""
    page = PAGE.read_text()
    begin, end = f"<!-- made by make {name} -->", f"<!-- end of make {name} -->"
    before, rest = page.split(begin)
    after = rest.split(end)[1]
    PAGE.write_text(f"{before}{begin}\n{date.today().isoformat()}\n\n{text}\n{end}{after}")

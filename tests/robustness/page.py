"""Generated parts of docs/measured/reliability.md, between marks."""

from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "reliability.md"


def read_part(name: str) -> list[str]:
    """Return the lines between the marks of a part."""
    begin, end = marks(name)
    return PAGE.read_text().split(begin)[1].split(end)[0].strip().splitlines()


def write_part(name: str, text: str) -> None:
    """Write text between the marks of a part."""
    begin, end = marks(name)
    before, rest = PAGE.read_text().split(begin)
    after = rest.split(end)[1]
    PAGE.write_text(f"{before}{begin}\n{text}\n{end}{after}")


def marks(name: str) -> tuple[str, str]:
    """Return the marks before and after a part."""
    return f"<!-- made by make {name} -->", f"<!-- end of make {name} -->"

"""Code blocks of the documentation, and a runner that executes those of a page in order."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[2]

PAGES = [
    ROOT / "README.md",
    *sorted(path for path in (ROOT / "docs").rglob("*.md") if "results" not in path.parts),
]
"""Pages that people write; pages of results are generated."""

NOT_RUN = re.compile(r"<!-- not run: (.+?) -->", re.DOTALL)
"""Comment before a block that cannot run in a test, with the reason."""

LANGUAGES = ("bash", "python", "yaml", "text", "console", "toml", "make", "latex", "bibtex")
"""Languages of blocks; those of bash and python are run."""


class Block(NamedTuple):
    """Code block of a page.

    Attributes:
        page: path of the page, relative to the repository.
        line: number of its first line.
        language: first word after the fence, in lower case.
        code: content.
        reason: reason why it is not run; empty if it is.
    """

    page: str
    line: int
    language: str
    code: str
    reason: str


def blocks(page: Path) -> Iterator[Block]:
    """Yield the fenced code blocks of a page; directives of the site, such as {toctree}, are none."""
    reason = ""
    for token in MarkdownIt().parse(page.read_text()):
        if token.type == "html_block" and (found := NOT_RUN.search(token.content)):
            reason = " ".join(found[1].split())
        elif token.type == "fence":
            language = token.info.strip().partition(" ")[0].lower()
            if not language.startswith("{"):
                line = token.map[0] + 1 if token.map else 0
                yield Block(str(page.relative_to(ROOT)), line, language, token.content, reason)
            reason = ""


def commands(block: Block) -> list[str]:
    """Return the commands of a bash block, without comments and with continued lines joined."""
    lines = re.sub(r"\\\n\s*", "", block.code).splitlines()
    return [line for line in (re.sub(r"(^|\s)#.*", "", line).strip() for line in lines) if line]


def in_a_test(command: str) -> str:
    """Return a command as a test runs it: trainings that set no scale are those of `scale=test`."""
    trains = re.match(r"(python -m imagination\.|imagination-)(train|study|render|prepare.shards)\b", command)
    resumes = "resume=" in command
    return f"{command} scale=test" if trains and "scale=" not in command and not resumes else command


def run_page(page: Path, folder: Path) -> None:
    """Run the bash and python blocks of a page in order in a folder; Python blocks share their variables.

    Raises:
        AssertionError: if a block fails.
    """
    bin_folder = Path(sys.executable).parent
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}",
    }
    python = ""
    for block in blocks(page):
        if block.reason or block.language not in ("bash", "python"):
            continue
        if block.language == "python":
            python += block.code
            words = [sys.executable, "-c", python]
        else:
            words = ["bash", "-ec", "\n".join(map(in_a_test, commands(block)))]
        done = subprocess.run(
            words, cwd=folder, env=environment, capture_output=True, text=True, timeout=1800
        )
        assert done.returncode == 0, f"{block.page}:{block.line}\n{block.code}\n{done.stderr[-3000:]}"

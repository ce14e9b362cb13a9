"""The page: complete, escaped, reproducible byte by byte, and correct in a browser."""

import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from markupsafe import Markup
from matplotlib.figure import Figure

from imagination.report import read, write
from imagination.reporting import html
from imagination.reporting.content import Content, Drawing, Section
from tests.helpers.run_folders import make_folder

EVIL = "<script>alert('x')</script><img src=http://example.org/x>\"&"
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
VOID = {"meta", "img", "source", "br", "link"}


def evil_folder(parent: Path) -> Path:
    """Return a results folder whose text would be harmful in a page."""
    made = make_folder(parent / "run", note=EVIL, seed=EVIL, choices=[f"+experiment={EVIL}"])
    (made / "tables" / "extra.csv").write_text(f'what,value\n"{EVIL.replace(chr(34), "")}",1\n')
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder with its report; drawing takes half a minute."""
    made = evil_folder(tmp_path_factory.mktemp("made"))
    write(made)
    return made


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder without a report."""
    return evil_folder(tmp_path_factory.mktemp("results"))


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace figures by an empty picture."""
    picture = Markup('<img src="data:image/png;base64,AA==" alt="{}">')
    monkeypatch.setattr(html, "picture", lambda drawing: picture.format(drawing.caption))


class Tree(HTMLParser):
    """Parser that checks the nesting of elements and collects their references."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.referred: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.referred += [value or "" for name, value in attrs if name in ("src", "srcset", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_whole_and_refers_to_nothing_outside(results: Path, undrawn: None) -> None:
    tree = Tree()
    tree.feed(html.html(read(results)))
    assert tree.open == []
    assert len(tree.referred) > 20
    assert all(target.startswith(("data:image/png;base64,", "#")) for target in tree.referred)
    assert "script" not in tree.tags


def test_everything_that_comes_from_files_is_escaped(results: Path, undrawn: None) -> None:
    text = html.html(read(results))
    assert "<script" not in text and "<img src=http" not in text
    assert text.count("&lt;script&gt;alert") >= 4  # config, seed, command, table


@pytest.mark.slow
def test_tables_and_figures_are_written_with_the_page(folder: Path) -> None:
    for stem in ("iou", "correct_pixels", "paired_iou", "paired_correct_pixels"):
        for kind in ("csv", "md", "tex"):
            assert (folder / "tables" / f"{stem}.{kind}").stat().st_size > 100
    pictures = {path.stem for path in (folder / "figures").glob("*.png")}
    assert pictures == {path.stem for path in (folder / "figures").glob("*.pdf")}
    assert {"maps_chair", "single_bed", "distribution_iou_chair", "viewpoints"} <= pictures
    assert cv2.imread(str(folder / "figures" / "maps_chair.png")).std() > 0


@pytest.mark.slow
def test_a_second_report_is_the_same_bytes(folder: Path) -> None:
    files = [path for path in folder.rglob("*") if path.is_file()]
    before = {path: path.read_bytes() for path in files}
    write(folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_an_incomplete_folder_is_marked(results: Path, undrawn: None, tmp_path: Path) -> None:
    copy = shutil.copytree(results, tmp_path / "run")
    table = copy / "records" / "trials.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:-3]))
    shutil.rmtree(copy / "maps")
    (copy / "single_views.npz").unlink()
    (copy / "records" / "thresholds.csv").unlink()
    text = html.html(read(copy))
    assert '<div class="problems"' in text and "trials missing" in text and "maps/ is missing" in text
    assert '<div class="problems"' not in html.html(read(results))


def test_names_from_tables_are_safe_file_names(tmp_path: Path) -> None:
    """Categories become names of files."""
    evil = Drawing("single_/../../../x", "A caption.", Figure)
    long = Drawing("ö" * 300, "Another.", Figure)
    content = Content("made", [], [], [Section("Figures", drawings=(evil, long))], [], "")
    html.write_figures(tmp_path / "run" / "figures", content, kinds=("png",))
    written = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    folder = Path("run") / "figures"
    assert written == {
        folder / "single__.._.._.._x_05fcb30c.png",
        folder / f"{'ö' * 41}_062c97f7.png",
    }


def test_names_with_signs_of_formulas_are_drawn_as_text() -> None:
    def draw() -> Figure:
        figure = Figure()
        figure.text(0.5, 0.5, r"$\frac$")
        return figure

    assert html.png(Drawing("a", "", draw), "light", 20)[1].startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_page_for_the_docs(folder: Path, tmp_path: Path) -> None:
    write(folder, tmp_path / "docs" / "study")
    text = (tmp_path / "docs" / "study.md").read_text()
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert (tmp_path / "docs" / target).stat().st_size > 0
    assert "| Imagination |" in text and f"docs={tmp_path}/docs/study" in text and "![" in text
    assert (tmp_path / "docs" / "study" / "mapping.csv").read_text() == (
        folder / "tables" / "mapping.csv"
    ).read_text()


def browse(tmp_path: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run headless Chromium without network; console messages are in its stderr."""
    options = [
        "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr",
        f"--user-data-dir={tmp_path / 'profile'}", "--allow-file-access-from-files", "--proxy-server=127.0.0.1:9",
    ]  # fmt: skip
    assert BROWSER is not None
    command = [BROWSER, *options, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed; apt-get install chromium")
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_in_a_browser_nothing_overflows_and_every_picture_loads(
    folder: Path, tmp_path: Path, dark: bool
) -> None:
    """At the width of a phone and of a desktop, side by side in frames of one document that measures them."""
    probe = tmp_path / "probe.html"
    widths = 390, 1280
    frames = "".join(
        f'<iframe style="border:0;width:{width}px;height:2000px" src="{(folder / "report.html").as_uri()}"></iframe>'
        for width in widths
    )
    probe.write_text(
        f"""<body style="margin:0;width:1800px">{frames}<p id="result"></p><script>
        window.onload = () => {{ result.textContent = [...document.querySelectorAll("iframe")].map(frame => {{
          const page = frame.contentDocument, root = page.documentElement;
          const pictures = [...page.images];
          const text = page.querySelector("h1").getBoundingClientRect();
          return [root.scrollWidth, pictures.length, pictures.filter(p => p.complete && p.naturalWidth).length,
            getComputedStyle(page.body).backgroundColor, pictures.filter(p => p.width < 250).length].join(" / ");
        }}).join(" ; "); }};
        </script></body>"""
    )
    theme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    done = browse(tmp_path, "--window-size=1800,2000", theme, "--dump-dom", probe.as_uri())
    assert "CONSOLE" not in done.stderr, done.stderr
    found = re.search(r'<p id="result">([^<]+)</p>', done.stdout)
    assert found, done.stderr
    for width, measured in zip(widths, found.group(1).split(" ; "), strict=True):
        scrolled, pictures, loaded, background, tiny = measured.split(" / ")
        assert int(scrolled) <= width, f"the page is {scrolled} wide in {width}"
        assert int(pictures) == int(loaded) > 10
        assert background == ("rgb(15, 19, 25)" if dark else "rgb(244, 246, 248)")
        assert int(tiny) == 0


@pytest.mark.slow
@pytest.mark.skipif(not (BROWSER and shutil.which("pdftoppm")), reason="Chromium or poppler-utils is missing")
def test_it_prints_on_a4_without_empty_pages_or_cut_figures(folder: Path, tmp_path: Path) -> None:
    pdf = tmp_path / "report.pdf"
    browse(tmp_path, f"--print-to-pdf={pdf}", "--no-pdf-header-footer", (folder / "report.html").as_uri())
    subprocess.run(["pdftoppm", "-r", "40", "-png", pdf, tmp_path / "page"], check=True)
    pages = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(tmp_path.glob("page*.png"))]
    assert 3 < len(pages) < 40
    for number, page in enumerate(pages):
        height, width = page.shape
        assert (width, height) == (331, 468)  # A4
        inked = page < 250
        rows = np.flatnonzero(inked.any(axis=1))
        assert len(rows), f"page {number} is empty"
        if number == 0:
            assert rows[-1] > height / 2, "the first page is nearly empty"
        margin = round(5 / 25.4 * 40)  # of 12 mm
        assert not inked[:, :margin].any() and not inked[:, -margin:].any(), f"page {number} is cut"
        assert not inked[:margin].any() and not inked[-margin:].any(), f"page {number} is cut"

"""The documentation site: built without warnings, every link and picture exists, pages load in a browser."""

import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

from tests.helpers.documentation import ROOT

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

PICTURES = """
<script>
addEventListener("load", () => {
  const broken = [...document.images].filter(image => !image.naturalWidth).map(image => image.src);
  const width = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  document.title = JSON.stringify({pictures: document.images.length, broken, overflow: width > 0});
});
</script>
</body>
"""
"""Script that writes what a browser found into the title of a page."""


class Links(HTMLParser):
    """Collector of the links, pictures and anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.targets.append(value)
            elif name == "id" and value:
                self.anchors.add(value)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site as `make docs` does."""
    folder = tmp_path_factory.mktemp("site")
    command = ["-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet", "docs", str(folder)]
    done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_every_link_and_picture_exists(site: Path) -> None:
    pages = {path: Links(path.read_text()) for path in site.rglob("*.html")}
    assert len(pages) > 200
    missing = []
    for path, page in pages.items():
        for target in page.targets:
            if re.match(r"[a-z]+:", target):
                continue  # another site, or data
            name, _, anchor = unquote(target).partition("#")
            linked = (path.parent / name.partition("?")[0]).resolve() if name else path
            if not linked.exists():
                missing.append(f"{path.relative_to(site)}: {target}")
            elif anchor and linked in pages and anchor not in pages[linked].anchors:
                missing.append(f"{path.relative_to(site)}: {target} (no such anchor)")
    assert not missing


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed; apt-get install chromium")
@pytest.mark.parametrize("name", ["index", "quickstart", "concepts/ground-truth", "results/chair_unet"])
def test_pages_load_in_a_browser(site: Path, name: str, tmp_path: Path) -> None:
    """No broken picture and no horizontal scroll at 1280 pixels."""
    page = site / f"{name}.html"
    probe = page.with_name("probe.html")
    probe.write_text(page.read_text().replace("</body>", PICTURES))
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1280,900", "--dump-dom"]
    words = [str(BROWSER), *options, f"--user-data-dir={tmp_path}", probe.as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    (title,) = re.findall(r"<title>(\{.*?\})</title>", done.stdout)
    found = json.loads(title.replace("&quot;", '"'))
    assert found["broken"] == [] and not found["overflow"]
    assert found["pictures"] > 0 or name == "quickstart"

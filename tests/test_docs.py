"""Checks that the documentation matches the code: links, references, commands and code blocks."""

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from imagination.config.compose import compose
from tests.helpers.documentation import LANGUAGES, PAGES, ROOT, blocks, commands, run_page

BLOCKS = [block for page in PAGES for block in blocks(page)]
ROBOT = ROOT / "docs" / "how-to" / "robot.md"


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def test_the_config_reference_is_up_to_date() -> None:
    made = runpy.run_path(str(ROOT / "docs" / "configuration.py"))["page"]()
    page = ROOT / "docs" / "reference" / "configuration.md"
    assert page.read_text() == made, "run: python docs/configuration.py"


OTHERS = [ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *(ROOT / "docs" / "results").glob("*.md")]


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=name_of)
def test_links_exist(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        assert (page.parent / target).exists(), f"{page} links to {target}"


def test_every_page_is_in_the_contents() -> None:
    text = (ROOT / "docs" / "index.md").read_text()
    listed = re.findall(r"^(?:[\w ]+<)?([\w/-]+)>?$", text, re.MULTILINE)
    pages = {str(path.relative_to(ROOT / "docs").with_suffix("")) for path in (ROOT / "docs").rglob("*.md")}
    assert set(listed) - {"reference/api/modules"} == pages - {"index"}


def test_the_readme_is_a_page() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 100


def test_blocks_are_run_or_say_why_not() -> None:
    assert len(BLOCKS) > 50
    for block in BLOCKS:
        place = f"{block.page}:{block.line}"
        assert block.language in LANGUAGES, place
        assert not block.reason or block.language in ("bash", "python"), f"{place}: is never run"
        assert "python -m" not in block.code or block.language != "text", f"{place}: use bash"


@pytest.mark.parametrize("page", [ROOT / "README.md"], ids=name_of)
def test_commands_compose(page: Path) -> None:
    check_commands(page)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_of_every_page_compose(page: Path) -> None:
    """Overrides of each command, also of those that are too long to run."""
    check_commands(page)


def check_commands(page: Path) -> None:
    """Check that the config of each command of a page can be composed, with the first value of each sweep.

    Commands with shell variables, placeholders, or options of a plugin that the page describes are left out.
    """
    found_blocks = list(blocks(page))
    own = re.compile(r"^# plugins/\w+/conf/(?:\S+/)?(\w+)\.yaml", re.MULTILINE)
    options = {name for block in found_blocks for name in own.findall(block.code)}
    for block in found_blocks:
        for command in commands(block) if block.language == "bash" else []:
            if set("$<") & set(command) or options & set(re.findall(r"\w+", command)):
                continue
            if found := re.match(r"(?:python -m imagination\.|imagination-)([\w-]+)(.*)", command):
                words = [word for word in shlex.split(found[2]) if not word.startswith("-")]
                compose(found[1].replace("-", "_"), [first_value(word) for word in words])


def first_value(override: str) -> str:
    """Return an override with the first of its comma-separated values."""
    (parsed,) = OverridesParser.create().parse_overrides([override])
    if not parsed.is_sweep_override():
        return override
    return f"{override.partition('=')[0]}={next(parsed.sweep_string_iterator())}"


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a chair unit of `scale=test` in outputs/, and an image with depth."""
    folder = tmp_path_factory.mktemp("trained")
    command = [sys.executable, "-m", "imagination.train", "experiment=chair_unet", "scale=test"]
    subprocess.run(command, cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)
    write_images(folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_the_blocks_of_a_page_run(page: Path, trained: Path, tmp_path: Path) -> None:
    shutil.copytree(trained, tmp_path, symlinks=True, dirs_exist_ok=True)
    run_page(page, tmp_path)


@pytest.mark.parametrize("page", [ROOT / "README.md", ROBOT], ids=name_of)
def test_python_examples_of_the_mapper_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unit_file: Path
) -> None:
    """The examples with a small untrained unit."""
    from imagination.mapping.map_io import load_layer

    code = mapper_example(page)
    assert len(code.splitlines()) < (15 if page.name == "README.md" else 30)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "best.onnx").symlink_to(unit_file)
    write_images(tmp_path)
    with pytest.warns(UserWarning, match="field of view"):
        exec(compile(code, str(page), "exec"), {})
    assert (load_layer(tmp_path / "my_map" / "map.yaml").layer >= 0).any()


def mapper_example(page: Path) -> str:
    """Return the example of a page that maps images, with best.onnx as its unit."""
    (code,) = (block.code for block in blocks(page) if "SemanticMapper(" in block.code)
    return re.sub(r'load\(".*?"\)', 'load("best.onnx")', code)


def write_images(folder: Path) -> None:
    """Write an image of noise and a depth image of a wall, as those of a robot."""
    rng = np.random.default_rng(0)
    cv2.imwrite(str(folder / "colour.png"), rng.integers(0, 256, (480, 640, 3), np.uint8))
    cv2.imwrite(str(folder / "depth.png"), np.full((480, 640), 2000, np.uint16))


ISOLATED = """
import re, sys
from importlib.metadata import packages_distributions, requires
code, allowed, pending = sys.argv[1], set(), sys.argv[2:]
while pending:
    name = re.split("[ ;<>=!~(]", pending.pop(), maxsplit=1)[0].lower().replace("_", "-")
    if name not in allowed:
        allowed.add(name)
        pending += [each for each in requires(name) or [] if "extra ==" not in each]
owners = packages_distributions().items()
owners = {module: {name.lower().replace("_", "-") for name in names} for module, names in owners}
class Block:
    def find_spec(self, name, path=None, target=None):
        module = name.partition(".")[0]
        if module != "imagination" and not owners.get(module, allowed) & allowed:
            raise ImportError("not in the list of the page: " + name)
sys.meta_path.insert(0, Block())
exec(compile(code, "example", "exec"), {})
from imagination.mapping.map_io import load_layer
assert (load_layer("my_map/map.yaml").layer >= 0).any()
try:
    import hydra
except ImportError as error:
    print(error)
"""


def test_the_robot_example_needs_only_the_packages_on_its_page(tmp_path: Path, unit_file: Path) -> None:
    (packages,) = re.findall(r"pip install (numpy numba .*)", ROBOT.read_text())
    (tmp_path / "best.onnx").symlink_to(unit_file)
    done = subprocess.run(
        [sys.executable, "-c", ISOLATED, mapper_example(ROBOT), *packages.split()],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "not in the list of the page: hydra" in done.stdout  # imports are blocked


def test_the_smallest_scene_source_is_small() -> None:
    example = ROOT / "tests" / "helpers" / "example_plugin"
    files = [
        example / "imagination_example" / "rooms.py",
        example / "conf" / "data" / "scenes" / "box_rooms.yaml",
    ]
    assert sum(len(path.read_text().splitlines()) for path in files) < 60

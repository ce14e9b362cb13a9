"""Checks that the documentation matches the code."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_the_config_reference_is_up_to_date() -> None:
    made = runpy.run_path(str(ROOT / "docs" / "configuration.py"))["page"]()
    assert (ROOT / "docs" / "configuration.md").read_text() == made, "run: python docs/configuration.py"


PAGES = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES)
def test_links_exist(page: str) -> None:
    path = ROOT / page
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", path.read_text()):
        assert (path.parent / target).exists(), f"{page} links to {target}"


def test_the_example_of_the_mapper_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unit_file: Path
) -> None:
    """The example of the README with a small untrained unit."""
    from imagination.mapping.map_io import load_layer

    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(code.splitlines()) < 30
    monkeypatch.chdir(tmp_path)
    (tmp_path / "best.onnx").symlink_to(unit_file)
    with pytest.warns(UserWarning, match="field of view"):
        exec(compile(code, "README.md", "exec"), {})
    assert (load_layer(tmp_path / "my_map" / "map.yaml").layer >= 0).any()


ISOLATED = """
import re, sys
from importlib.metadata import packages_distributions, requires
from pathlib import Path
allowed, pending = set(), sys.argv[1:]
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
            raise ImportError("not in the README's list: " + name)
sys.meta_path.insert(0, Block())
(code,) = re.findall(r"```python\\n(.*?)```", Path(sys.argv[0]).read_text(), re.DOTALL)
exec(compile(code, "README.md", "exec"), {})
from imagination.mapping.map_io import load_layer
assert (load_layer("my_map/map.yaml").layer >= 0).any()
try:
    import hydra
except ImportError as error:
    print(error)
"""


def test_the_example_needs_only_the_packages_in_the_readme(tmp_path: Path, unit_file: Path) -> None:
    readme = ROOT / "README.md"
    (packages,) = re.findall(r"`pip install (numpy numba [^`]*)` are enough", readme.read_text())
    (tmp_path / "best.onnx").symlink_to(unit_file)
    code = ISOLATED.replace("sys.argv[0]", repr(str(readme)))
    done = subprocess.run(
        [sys.executable, "-c", code, *packages.split()],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "not in the README's list: hydra" in done.stdout  # imports are blocked


def test_the_smallest_scene_source_is_small() -> None:
    example = ROOT / "tests" / "helpers" / "example_plugin"
    files = [
        example / "imagination_example" / "rooms.py",
        example / "conf" / "data" / "scenes" / "box_rooms.yaml",
    ]
    lines = sum(len(path.read_text().splitlines()) for path in files)
    assert lines < 60 and f"{lines} lines" in (ROOT / "docs" / "scene-sources.md").read_text()

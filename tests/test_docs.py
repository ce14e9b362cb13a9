"""The documentation follows the code."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_the_config_reference_is_up_to_date() -> None:
    made = runpy.run_path(str(ROOT / "docs" / "configuration.py"))["page"]()
    assert (ROOT / "docs" / "configuration.md").read_text() == made, "run: python docs/configuration.py"


PAGES = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    path = ROOT / page
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", path.read_text()):
        assert (path.parent / target).exists(), f"{page} links to {target}"


def test_the_example_of_the_mapper_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unit_file: Path
) -> None:
    """As it stands in the README, with a small unit that was never trained."""
    from imagination.mapping.files import load_layer

    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(code.splitlines()) < 30
    monkeypatch.chdir(tmp_path)
    (tmp_path / "best.onnx").symlink_to(unit_file)
    with pytest.warns(UserWarning, match="field of view"):
        exec(compile(code, "README.md", "exec"), {})
    assert (load_layer(tmp_path / "my_map" / "map.yaml").layer >= 0).any()


def test_the_smallest_scene_source_is_small() -> None:
    example = ROOT / "tests" / "plugins_example"
    files = [
        example / "imagination_example" / "rooms.py",
        example / "conf" / "data" / "scenes" / "box_rooms.yaml",
    ]
    lines = sum(len(path.read_text().splitlines()) for path in files)
    assert lines < 60 and f"{lines} lines" in (ROOT / "docs" / "scene-sources.md").read_text()

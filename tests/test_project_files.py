"""Project files: citation, contribution guide, templates, workflow, name of the distribution, install lines."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from imagination.utils.errors import install_command
from imagination.utils.provenance import DISTRIBUTION
from tests.conftest import ROOT

GITHUB = ROOT / ".github"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TREE = (
    "imagination",
    "plugins",
    "conf",
    "docs",
    "tests",
    ".github",
    "*.md",
    "pyproject.toml",
    "requirements.lock",
)
TEXT = {".py", ".md", ".yaml", ".yml", ".toml", ".lock", ".txt", ".j2"}


def load(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def text_files() -> list[Path]:
    roots = [path for pattern in TREE for path in ROOT.glob(pattern)]
    files = [file for root in roots for file in (root.rglob("*") if root.is_dir() else [root])]
    return [file for file in files if file.suffix in TEXT]


def test_the_citation_has_the_required_keys_of_its_format() -> None:
    """Citation File Format 1.2.0: required keys of the file, of persons and entities, and of references."""
    citation = load(ROOT / "CITATION.cff")
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["cff-version"] == "1.2.0" and citation["type"] == "software"
    assert citation["license"] == PROJECT["license"] and citation["version"] == PROJECT["version"]
    assert all(author.keys() == {"name"} for author in citation["authors"])
    (paper,) = citation["references"]
    assert {"authors", "title", "type"} <= paper.keys() and paper["type"] == "conference-paper"
    assert all(author.keys() == {"family-names", "given-names"} for author in paper["authors"])
    assert paper["conference"].keys() == {"name"} and isinstance(paper["year"], int)


def test_the_workflow_runs_the_commands_of_developers() -> None:
    workflow = load(GITHUB / "workflows" / "test.yml")
    commands = {
        name: [step["run"] for step in job["steps"] if "run" in step]
        for name, job in workflow["jobs"].items()
    }
    assert commands == {"test": ["make test"], "docs": ["make docs"]}
    assert {"push", "pull_request"} <= workflow[True].keys()  # YAML 1.1 reads the key `on` as a Boolean
    lowest = PROJECT["requires-python"].removeprefix(">=")
    tested = workflow["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert tested[0] == lowest and int(tested[-1].split(".")[1]) > int(lowest.split(".")[1])


@pytest.mark.parametrize("name", ["bug_report", "feature_request"])
def test_issue_forms_have_the_fields_that_github_requires(name: str) -> None:
    form = load(GITHUB / "ISSUE_TEMPLATE" / f"{name}.yml")
    assert {"name", "description", "body"} <= form.keys()
    fields = [field for field in form["body"] if field["type"] != "markdown"]
    ids = [field["id"] for field in fields]
    assert len(set(ids)) == len(ids) and all(field["attributes"]["label"] for field in fields)
    assert any(field.get("validations", {}).get("required") for field in fields)


def test_the_chooser_of_issue_forms_is_configured() -> None:
    assert load(GITHUB / "ISSUE_TEMPLATE" / "config.yml").keys() == {"blank_issues_enabled"}


@pytest.mark.parametrize("path", ["CONTRIBUTING.md", ".github/PULL_REQUEST_TEMPLATE.md"])
def test_named_files_and_targets_exist(path: str) -> None:
    """Paths in code spans that begin with a folder of the project, and targets of make."""
    text = (ROOT / path).read_text()
    for name in re.findall(r"`((?:imagination|tests|conf|docs)/[\w/.]+)`", text):
        assert (ROOT / name).exists(), name
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"\bmake ([a-z]+)`", text)) <= targets


def test_the_changelog_has_no_heading_twice() -> None:
    headings = re.findall(r"^#+ .*", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert len(set(headings)) == len(headings) and "## [Unreleased]" in headings


def test_the_layers_in_the_contribution_guide_are_those_of_the_contract() -> None:
    importlinter = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = [" ".join(layer.split()) for layer in importlinter["contracts"][0]["layers"][2:]]
    assert "\n".join(f"    {layer}" for layer in layers) in (ROOT / "CONTRIBUTING.md").read_text()


def test_the_distribution_is_looked_up_by_its_name() -> None:
    assert PROJECT["name"] == DISTRIBUTION


def test_no_text_installs_the_other_project_of_this_name() -> None:
    """`imagination` on PyPI is another project; this one is installed from its checkout or its wheel."""
    other = re.compile(r"""['"]imagination\\?\[|pip install (-U )?imagination\b""")
    found = [str(file.relative_to(ROOT)) for file in text_files() if other.search(file.read_text())]
    assert not found, found


def test_named_extras_exist() -> None:
    """In install lines, and in calls of the functions that write them."""
    pattern = re.compile(
        r"""pip install -e ['"]\.\[(\w+)\]|require_extra\(\s*"\w+", "(\w+)"|install_command\(['"](\w+)"""
    )
    named = {
        extra
        for file in text_files()
        for match in pattern.finditer(file.read_text())
        for extra in match.groups()
        if extra
    }
    assert {"shards", "onnx", "ros", "scans"} <= named <= {*PROJECT["optional-dependencies"], "EXTRA"}
    assert "pip install -e '.[scans]'" in install_command("scans")

"""Imports: geometry and mapping need no torch, and commands start quickly."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from imagination.__main__ import commands
from imagination.config.plugin_registry import discover
from tests.conftest import ROOT

TORCH_FREE = "geometry scenes ground_truth views mapping recordings viewers"

BLOCKED = f"""
import importlib, pathlib, sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "hydra", "lightning", "omegaconf"):
            raise ImportError("blocked: " + name)
sys.meta_path.insert(0, Block())
root = pathlib.Path("imagination")
files = [root / "utils" / "errors.py", root / "utils" / "cache.py", root / "config" / "plugin_registry.py"]
files += [root / "deployment" / "load.py", root / "deployment" / "onnx_backend.py"]
files += [path for package in {TORCH_FREE.split()!r} for path in sorted((root / package).rglob("*.py"))]
for path in files:
    name = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    importlib.import_module(name)
print(len(files))
"""


PUBLIC = (
    *("geometry", "ground_truth", "mapping", "recordings", "utils", "views", "deployment", "viewers"),
    *("scenes.building_blocks", "scenes.categories", "scenes.free_space", "scenes.renderer", "scenes.scene"),
    *("scenes.sensor", "scenes.source", "models", "callbacks", "data"),
)
"""Packages and modules of imagination that plugins may import."""


def python(*arguments: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_geometry_and_mapping_need_no_torch() -> None:
    done = python("-c", BLOCKED)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 15


HEAVY = {"torch", "lightning", "timm", "matplotlib", "torchmetrics", "onnxruntime"}


def imported_by(folder: Path, *arguments: str) -> set[str]:
    """Names of all modules that `python -m <arguments>` imports."""
    done = python("-X", "importtime", "-m", *arguments, folder=folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout
    return {line.rpartition("|")[2].strip() for line in done.stderr.splitlines() if "import time:" in line}


def plugin_modules(modules: set[str]) -> set[str]:
    """Modules of plugins among the names of modules."""
    packages = {package for plugin in discover() for package in plugin.packages}
    packages |= {
        f"hydra_plugins.{path.parent.name}" for path in ROOT.glob("plugins/*/hydra_plugins/*/__init__.py")
    }
    assert {"imagination_sweethome3d", "imagination_scans", "hydra_plugins.imagination_ray"} <= packages
    return {name for name in modules if any(f"{name}.".startswith(f"{package}.") for package in packages)}


HELP_OF_ALL = """
import runpy, sys
for name in sys.argv[1:]:
    sys.argv = [name, "--help"]
    try:
        runpy.run_module(f"imagination.{name}", run_name="__main__")
    except SystemExit as ended:
        assert not ended.code, name
    assert "hydra" in sys.modules and "imagination.config.plugin_registry" in sys.modules
    print("\\nend of", name, *sys.modules)
"""


def test_help_imports_no_torch_and_no_plugin(example_plugin: Path, tmp_path: Path) -> None:
    """All commands in one process; the benchmark `startup` measures how fast it is."""
    done = python("-c", HELP_OF_ALL, *commands(), folder=tmp_path)
    assert done.returncode == 0, done.stderr
    ends = [line.split()[2:] for line in done.stdout.splitlines() if line.startswith("end of ")]
    assert [name for name, *_ in ends] == list(commands())
    for name, *modules in ends:
        assert not set(modules) & HEAVY, name
        assert not plugin_modules(set(modules)), name
    assert {path.name for path in tmp_path.iterdir()} == {"plugins"}


@pytest.mark.slow
def test_the_list_of_plugins_imports_no_torch_and_no_plugin(example_plugin: Path, tmp_path: Path) -> None:
    modules = imported_by(tmp_path, "imagination.plugins")
    assert "imagination.config.plugin_registry" in modules
    assert not modules & HEAVY
    assert not plugin_modules(modules)
    assert plugin_modules(imported_by(tmp_path, "imagination.plugins", "check=true"))


def test_the_list_of_commands_imports_only_the_standard_library(tmp_path: Path) -> None:
    modules = imported_by(tmp_path, "imagination")
    assert not modules & (HEAVY | {"hydra", "omegaconf", "numpy", "yaml"})
    assert {name for name in modules if name.startswith("imagination.")} == {"imagination.__main__"} & modules


def test_shapes_are_checked() -> None:
    import numpy as np
    from beartype.roar import BeartypeCallHintViolation
    from jaxtyping import TypeCheckError

    from imagination.geometry.pose import Pose

    with pytest.raises((BeartypeCallHintViolation, TypeCheckError)):
        Pose(0.0, 0.0, 0.0).to_world(np.zeros((4, 3)))


def private_imports(code: str) -> list[str]:
    """Names that code imports from imagination although they are not public."""
    allowed = tuple(f"imagination.{name}." for name in PUBLIC)
    return [
        f"{node.module}.{alias.name}"
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "imagination"
        for alias in node.names
        if not f"{node.module}.".startswith(allowed) or alias.name.startswith("_")
    ]


def test_plugins_import_only_what_is_public() -> None:
    files = [*ROOT.glob("plugins/**/*.py"), *(ROOT / "tests" / "helpers" / "example_plugin").glob("**/*.py")]
    assert len(files) > 20
    for file in files:
        assert not private_imports(file.read_text()), file
    assert private_imports("from imagination.runs.resume import Run") == ["imagination.runs.resume.Run"]

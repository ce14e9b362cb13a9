"""Imports: geometry and mapping need no torch, and commands start quickly."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

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


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)


def test_geometry_and_mapping_need_no_torch() -> None:
    done = python(BLOCKED)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 15


def test_importing_commands_does_not_import_torch() -> None:
    code = "import sys, imagination.{0}; sys.exit('torch' in sys.modules or 'lightning' in sys.modules)"
    for name in ("train", "evaluate", "render", "map", "export", "serve"):
        done = python(code.format(name))
        assert done.returncode == 0, (name, done.stderr)


@pytest.mark.parametrize("arguments", [("imagination.train", "--help"), ("imagination.plugins",)])
def test_help_and_plugin_listing_import_no_torch(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """Both answer at once; the benchmark `startup` measures how fast."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", *arguments],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    imported = {
        line.rpartition("|")[2].strip() for line in done.stderr.splitlines() if "import time:" in line
    }
    assert "imagination.config.plugin_registry" in imported
    assert not imported & {"torch", "lightning", "timm", "matplotlib"}


def test_shapes_are_checked() -> None:
    import numpy as np
    from beartype.roar import BeartypeCallHintViolation
    from jaxtyping import TypeCheckError

    from imagination.geometry.pose import Pose

    with pytest.raises((BeartypeCallHintViolation, TypeCheckError)):
        Pose(0.0, 0.0, 0.0).to_world(np.zeros((4, 3)))


def test_plugins_import_only_what_is_public() -> None:
    files = [*ROOT.glob("plugins/**/*.py"), *(ROOT / "tests" / "helpers" / "example_plugin").glob("**/*.py")]
    assert len(files) > 20
    allowed = tuple(f"imagination.{name}" for name in PUBLIC)
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "imagination":
                assert any(f"{node.module}.".startswith(f"{name}.") for name in allowed), (file, node.module)
                assert not any(alias.name.startswith("_") for alias in node.names), (file, node.module)

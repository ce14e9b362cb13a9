"""What may be imported where: geometry and mapping do without torch, commands answer quickly."""

import resource
import subprocess
import sys

from tests.conftest import ROOT, Command

LIGHT = "geometry scenes ground_truth views mapping recordings viewers"

BLOCKED = f"""
import importlib, pathlib, sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "hydra", "lightning", "omegaconf"):
            raise ImportError("blocked: " + name)
sys.meta_path.insert(0, Block())
root = pathlib.Path("imagination")
files = [root / "errors.py", root / "categories.py", root / "plugins.py", root / "cache.py"]
files += [root / "deployment" / "load.py", root / "deployment" / "onnx_module.py"]
files += [path for room in {LIGHT.split()!r} for path in sorted((root / room).rglob("*.py"))]
for path in files:
    name = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    importlib.import_module(name)
print(len(files))
"""


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)


def test_geometry_and_mapping_need_no_torch() -> None:
    done = python(BLOCKED)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 15


def test_commands_import_no_torch_before_they_work() -> None:
    code = "import sys, imagination.{0}; sys.exit('torch' in sys.modules or 'lightning' in sys.modules)"
    for name in ("train", "evaluate", "render", "map", "export", "serve"):
        done = python(code.format(name))
        assert done.returncode == 0, (name, done.stderr)


def test_help_and_plugin_listing_are_quick(command: Command) -> None:
    for arguments in (("train", "--help"), ("plugins",)):
        before = processor_seconds()
        assert command(*arguments).returncode == 0
        assert processor_seconds() - before < 2.0, arguments


def processor_seconds() -> float:
    """Of the processes that were waited for: other work on the machine does not count."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def test_shapes_are_really_checked() -> None:
    import numpy as np
    import pytest
    from beartype.roar import BeartypeCallHintViolation
    from jaxtyping import TypeCheckError

    from imagination.geometry.pose import Pose

    with pytest.raises((BeartypeCallHintViolation, TypeCheckError)):
        Pose(0.0, 0.0, 0.0).to_world(np.zeros((4, 3)))

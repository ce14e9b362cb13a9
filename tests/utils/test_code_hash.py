"""Hashes of source code: an edit of a module or of what it imports changes the hash, and nothing else does."""

import shutil
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import grimp
import pytest

import imagination
from imagination.evaluation import prediction, protocol
from imagination.runs import program
from imagination.scenes.procedural import source
from imagination.utils import code_hash
from imagination.utils.cache import BUILDERS
from imagination.utils.code_hash import code_of, core_hash, is_plugin, module_hash, module_of
from imagination.utils.errors import UserError
from tests.conftest import ROOT
from tests.helpers.plugin_modules import edit, new_process, write

MODULES = {
    "__init__": "LABEL = 1\n",
    "rule": """
import math, numpy, imagination.geometry.grid
from edited_pack import by_name, nothing_of_this_name
from .relative import value
from edited_other.inner import other
def late():
    from edited_pack.nested import deep
""",
    "by_name": "import edited_pack.chained\n",
    "chained": "value = 1\n",
    "relative": "value = 1\n",
    "unused": "import edited_pack.rule\n",
}
USED = [
    *("edited_pack/__init__.py", "edited_pack/rule.py", "edited_pack/by_name.py", "edited_pack/chained.py"),
    *("edited_pack/relative.py", "edited_pack/nested/__init__.py", "edited_pack/nested/deep.py"),
    *("edited_other/__init__.py", "edited_other/inner.py"),
]


def hashed(folder: Path, module: str = "edited_pack.rule") -> str:
    """Return the hash of a module as a new process computes it."""
    with new_process(folder):
        return module_hash(module)


@pytest.fixture
def pack(tmp_path: Path) -> Path:
    write(tmp_path / "edited_pack", **MODULES)
    write(tmp_path / "edited_pack" / "nested", deep="value = 1\n")
    write(tmp_path / "edited_other", inner="from edited_pack import rule\nother = 1\n")  # a circle
    return tmp_path


@pytest.mark.parametrize("file", USED)
def test_an_edit_of_what_is_imported_changes_the_hash(pack: Path, file: str) -> None:
    before = hashed(pack)
    (pack / file).touch()
    assert hashed(pack) == before
    with open(pack / file, "a") as module:
        module.write("# a comment\n")
    assert hashed(pack) != before


def test_other_modules_do_not_change_the_hash(pack: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    before = hashed(pack)
    (pack / "edited_pack" / "unused.py").write_text("value = 2\n")
    (pack / "math.py").write_text("")
    assert hashed(pack) == before
    copy = shutil.copytree(pack, tmp_path_factory.mktemp("copy") / "elsewhere")
    assert hashed(copy) == before


def test_a_module_is_read_once_in_a_process(pack: Path) -> None:
    with new_process(pack):
        before = module_hash("edited_pack.rule")
        edit(pack / "edited_pack" / "chained.py", "1", "2")
        assert module_hash("edited_pack.rule") == before
    assert hashed(pack) != before


def test_nothing_is_imported(pack: Path) -> None:
    (pack / "edited_pack" / "nested" / "__init__.py").write_text("raise RuntimeError\n")
    hashed(pack)
    assert not {name for name in sys.modules if name.startswith("edited_")}


def test_a_malformed_module_is_hashed_without_its_imports(pack: Path) -> None:
    (pack / "edited_pack" / "chained.py").write_text("import (\n")
    before = hashed(pack)
    (pack / "edited_pack" / "chained.py").write_text("import ((\n")
    assert hashed(pack) != before


def test_an_installed_distribution_is_hashed_if_it_is_a_plugin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site-packages"
    write(site / "edited_pack", rule="import edited_library, edited_pack.inner\n", inner="")
    write(site / "edited_library", inner="")
    with new_process(site):
        assert not is_plugin("edited_pack.rule") and code_of("edited_pack.rule") == "edited_pack "
    points = [EntryPoint("rooms", "edited_pack.conf", code_hash.GROUP)]
    monkeypatch.setattr("imagination.utils.code_hash.entry_points", lambda group: points)
    with new_process(site):
        assert is_plugin("edited_pack.rule") and not is_plugin("edited_library.inner")
    before = hashed(site)
    (site / "edited_library" / "__init__.py").write_text("# edited")
    assert hashed(site) == before
    (site / "edited_pack" / "inner.py").write_text("# edited")
    assert hashed(site) != before


def test_only_plugins_are_hashed_by_module() -> None:
    import torch

    assert code_of("torch.nn.modules.conv") == f"torch {torch.__version__}"
    assert (
        code_of("imagination.mapping.update_rules") == code_of("collections.abc") == code_of("builtins") == ""
    )
    assert code_of("tests.helpers.room_source") == module_hash("tests.helpers.room_source")


def test_code_without_a_file_is_refused() -> None:
    with pytest.raises(UserError, match="cache: got .*'no_such_module'.*expected a module in a file"):
        code_of("no_such_module")


def test_a_script_is_hashed(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import helper\nfrom imagination.utils.code_hash import module_hash\nprint(module_hash('__main__'))\n"
    )
    hashes = set()
    for number in range(2):
        (tmp_path / "helper.py").write_text(f"value = {number}\n")
        done = subprocess.run(
            [sys.executable, str(script)],
            env={"PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=True,
        )
        hashes.add(done.stdout)
    assert len(hashes) == 2


def test_the_module_of_a_target() -> None:
    assert module_of("imagination.geometry.camera.Camera.from_degrees") == "imagination.geometry.camera"
    assert module_of("no_such_module.Class") == module_of("") == ""


def test_the_core_is_hashed_by_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = core_hash(["geometry", "utils/jit.py"])
    copy = tmp_path / "imagination"
    shutil.copytree(ROOT / "imagination", copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(code_hash, "__file__", str(copy / "utils" / "code_hash.py"))
    assert core_hash(["geometry", "utils/jit.py"]) == before
    for file, same in {
        "geometry/crop.py": False,
        "utils/jit.py": False,
        "utils/errors.py": True,
        "scenes/scene.py": True,
    }.items():
        with open(copy / file, "a") as code:
            code.write("# a comment\n")
        code_hash._core_digests.cache_clear()
        after = core_hash(["geometry", "utils/jit.py"])
        assert (after == before) == same
        before = after


UNRELATED = (
    *("atomic_io", "cache", "cache_key", "code_hash", "errors", "file_lock", "file_names", "interrupts"),
    *("progress", "tabular", "timing"),
)
"""Modules of utils that determine no results: writing, keys, messages."""

CACHED = {
    "ground truth and views": (("views", "evaluation.trials"), BUILDERS),
    "results of trials": (
        ("evaluation.trial_worker", "evaluation.protocol", "evaluation.prediction"),
        (*BUILDERS, *protocol.PACKAGES, *prediction.PACKAGES),
    ),
    "trainings": (
        (
            *("data", "models.lit_unit", "models.segmentation", "models.projected_unit"),
            *("callbacks.replay_buffer", "callbacks.early_stopping", "callbacks.seed_per_epoch"),
        ),
        program.PACKAGES,
    ),
    "homes": (("scenes.procedural.scene_builder",), source.BUILDERS),
}


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("imagination", exclude_type_checking_imports=True)


@pytest.mark.parametrize("kind", CACHED)
def test_all_code_that_determines_a_cached_result_is_hashed(kind: str, graph: grimp.ImportGraph) -> None:
    names, hashed_paths = CACHED[kind]
    package = Path(imagination.__file__).parent
    assert all((package / path).exists() for path in hashed_paths)
    used: set[str] = set()
    for name in names:
        module = f"imagination.{name}"
        used |= {module} | graph.find_upstream_modules(
            module, as_package=not graph.find_children(module) == set()
        )
    paths = {name.removeprefix("imagination.").replace(".", "/") for name in used} - {"imagination"}
    missing = {
        path
        for path in paths
        if (package / f"{path}.py").is_file()
        and not any(f"{path}.py/".startswith(f"{hashed_path}/") for hashed_path in hashed_paths)
        and path.removeprefix("utils/") not in UNRELATED
    }
    assert not missing

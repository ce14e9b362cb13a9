"""Plugins whose files are written and edited during a test."""

import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest

from imagination.utils import code_hash


def write(folder: Path, **files: str) -> None:
    """Write the modules of a package, with an empty `__init__.py` unless it is given."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "__init__.py").touch()
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text)


def edit(path: Path, old: str, new: str) -> None:
    """Replace a text that occurs in a file."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


Import = Callable[[str], ModuleType]


@contextmanager
def new_process(folder: Path) -> Iterator[Import]:
    """Import and hash the modules in a folder anew, as a new process does; yield the function that imports them."""
    forget(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setattr(sys, "dont_write_bytecode", True)  # bytecode of the same second would not be outdated
        try:
            yield importlib.import_module
        finally:
            forget(folder)


def forget(folder: Path) -> None:
    """Forget the modules in a folder and the code that was hashed."""
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", "")).startswith(str(folder)):
            del sys.modules[name]
    importlib.invalidate_caches()
    for cached in (
        *(code_hash.module_hash, code_hash._source, code_hash._spec),
        *(code_hash._is_installed, code_hash._installed_plugins),
    ):
        cached.cache_clear()

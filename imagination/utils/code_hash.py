"""Hashes of source code, by which cached results of other code are recognised.

A process reads a source file once, like the code itself: an edit changes the keys of the next process, which runs it.
"""

import ast
import hashlib
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import entry_points
from importlib.util import find_spec, resolve_name
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from imagination.utils.errors import UserError

CORE = __name__.partition(".")[0]
"""Top-level package of the core, whose packages are hashed as a whole."""

GROUP = "imagination.plugins"
"""Entry-point group of plugins: name of the plugin, and its conf package, e.g. "imagination_rooms.conf"."""

INSTALLED = ("site-packages", "dist-packages")
"""Names of the folders of installed distributions."""

MAIN = "__main__"
"""Name of the module of a script."""


class Source(NamedTuple):
    """Source of a module.

    Attributes:
        digest: hash of the file; empty for a package without `__init__.py`.
        imports: dotted names in import statements; the last part may be an attribute of a module.
    """

    digest: str
    imports: tuple[str, ...]


def core_hash(paths: Iterable[str]) -> str:
    """Return the hash of the code of packages and modules of the core, e.g. "geometry" or "utils/jit.py"."""
    chosen = tuple(f"{path}/" for path in paths)
    digests = _core_digests(Path(__file__).parents[1]).items()
    return _digest(
        repr([(file, digest) for file, digest in digests if f"{file}/".startswith(chosen)]).encode()
    )


def code_of(module: str) -> str:
    """Return what identifies the code of a loaded module.

    Returns:
        `module_hash` of a module of a plugin, name and version of the installed distribution of another module; empty
        for the core, whose keys hold `core_hash`, and the standard library.
    """
    if is_plugin(module):
        return module_hash(module)
    if is_core(module) or is_standard(module):
        return ""
    return f"{_top(module)} {getattr(sys.modules.get(_top(module)), '__version__', '')}"


def is_core(module: str) -> bool:
    """Return whether a module belongs to the core."""
    return _top(module) == CORE


def is_standard(module: str) -> bool:
    """Return whether a module belongs to the standard library."""
    return _top(module) in sys.stdlib_module_names


def is_plugin(module: str) -> bool:
    """Return whether a module belongs to a plugin: an installed one, or any code that is no installed distribution."""
    if is_core(module) or is_standard(module):
        return False
    return not _is_installed(_top(module)) or _top(module) in _installed_plugins()


@cache
def module_hash(name: str) -> str:
    """Return the hash of the source of a module and of all modules that it imports, directly or indirectly.

    Import statements are found by parsing, also inside functions; nothing is imported. The core, the standard library
    and installed distributions other than that of the module are not followed, nor are imports by a computed name.

    Raises:
        UserError: if the module has no source file.
    """
    if (own := _source(name)) is None or not own.digest:
        raise UserError(
            f"cache: got code in the module {name!r}, which has no source file, expected a module in a file; move the "
            "class or function into one, so that cached results depend on its code"
        )
    digests: dict[str, str] = {}
    pending = [name]
    while pending:
        parts = pending.pop().split(".")
        for module in accumulate(parts, "{}.{}".format):  # importing a module runs its packages
            if module in digests or not _is_followed(module, name):
                continue
            if (source := _source(module)) is not None:
                digests[module] = source.digest
                pending += source.imports
    return _digest(repr(sorted(digests.items())).encode())


def module_of(target: str) -> str:
    """Return the module in the dotted name of a class or function; empty if there is none."""
    modules = list(accumulate(target.split(".")[:-1], "{}.{}".format))
    return next((module for module in reversed(modules) if _spec(module) is not None), "")


def _is_followed(module: str, start: str) -> bool:
    """Return whether `module_hash` of the module `start` includes another module."""
    if _top(module) == _top(start):
        return True
    return not (is_core(module) or is_standard(module) or _is_installed(_top(module)))


@cache
def _is_installed(top: str) -> bool:
    """Return whether a top-level package belongs to an installed distribution."""
    if (spec := _spec(top)) is None:
        return False
    places = [spec.origin or "", *(spec.submodule_search_locations or [])]
    return any(name in Path(place).parts for place in places for name in INSTALLED)


@cache
def _installed_plugins() -> frozenset[str]:
    """Return the top-level packages of installed plugins."""
    return frozenset(_top(point.value) for point in entry_points(group=GROUP))


@cache
def _source(module: str) -> Source | None:
    """Return the source of a module; None if there is no such module."""
    spec = _spec(module)
    file = _file(module, spec)
    if file is None:
        return None if spec is None else Source("", ())
    content = file.read_bytes()
    package = spec.parent if spec is not None else None
    return Source(_digest(content), _imports(content, package or "") if file.suffix == ".py" else ())


def _file(module: str, spec: ModuleSpec | None) -> Path | None:
    """Return the file of a module; None if it has none."""
    origin = spec.origin if spec is not None else None
    if module == MAIN:  # a script has no specification
        origin = getattr(sys.modules[MAIN], "__file__", None)
    return Path(origin) if origin is not None and Path(origin).is_file() else None


def _imports(content: bytes, package: str) -> tuple[str, ...]:
    """Return the dotted names in the import statements of a source; none if it is malformed."""
    try:
        return tuple(_names(ast.parse(content), package))
    except (SyntaxError, ValueError, ImportError):
        return ()


def _names(tree: ast.Module, package: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), package)
            yield from (base if alias.name == "*" else f"{base}.{alias.name}" for alias in node.names)


@cache
def _spec(module: str) -> ModuleSpec | None:
    """Return the specification of a module without importing it or its packages; None if there is none."""
    parent = module.rpartition(".")[0]
    try:
        if not parent:
            return find_spec(module)
    except (ImportError, ValueError):  # a module that was made at run time has none
        return None
    package = _spec(parent)
    if package is None or package.submodule_search_locations is None:
        return None
    return PathFinder.find_spec(module, list(package.submodule_search_locations))


@cache
def _core_digests(root: Path) -> dict[str, str]:
    """Return the hash of each source file of the core by its path in the package."""
    paths = sorted(root.rglob("*.py"))
    return {path.relative_to(root).as_posix(): _digest(path.read_bytes()) for path in paths}


def _top(module: str) -> str:
    return module.partition(".")[0]


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()

"""Descriptions of objects by plain values, for the keys of cached results."""

import hashlib
import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from functools import partial
from types import BuiltinFunctionType, FunctionType
from typing import Any

from imagination.utils.code_hash import code_of, is_core, is_plugin, module_hash
from imagination.utils.errors import UserError


def as_plain(value: Any) -> Any:
    """Describe a value by plain values: numbers, strings, lists, dicts, None.

    A dataclass is described by its class and the arguments of its constructor, another object by its class and what
    pickle stores of it. The name of a class or function outside the core is followed by its code (see `code_of`), so
    that the description changes when the code is edited.

    Raises:
        UserError: if a value cannot be described, e.g. a lambda or an open file.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()
    if isinstance(value, (type, FunctionType, BuiltinFunctionType)):
        return _named(value)
    if not _is_of_plugin(value) and isinstance(value, (Mapping, Sequence, Set)):
        return _container(value)
    if is_dataclass(value) and _has_only_fields(value):
        arguments = {item.name: as_plain(getattr(value, item.name)) for item in fields(value) if item.init}
        return {"class": _named(type(value)), **arguments}
    return {"class": _named(type(value)), "state": _state(value)}


def plugin_code(value: Any) -> dict[str, str]:
    """Return the hash of the code of each module of a plugin that defines a value or an object that it holds.

    Objects are searched in attributes of objects of the core and of plugins, and in containers.

    Raises:
        UserError: if such a module has no source file.
    """
    code: dict[str, str] = {}
    seen: dict[int, Any] = {}  # keeps the objects, so that no other object gets the same id
    pending = [value]
    while pending:
        item = pending.pop()
        if id(item) in seen or isinstance(item, (str, bytes)):
            continue
        seen[id(item)] = item
        module = (item if isinstance(item, (type, FunctionType)) else type(item)).__module__ or "builtins"
        if is_plugin(module):
            code[module] = module_hash(module)
        pending += _held_by(item, module)
    return dict(sorted(code.items()))


def _is_of_plugin(value: Any) -> bool:
    return is_plugin(type(value).__module__)


def _container(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): as_plain(item) for key, item in value.items()}
    plain = [as_plain(item) for item in value]
    return sorted(plain, key=repr) if isinstance(value, Set) else plain


def _has_only_fields(value: Any) -> bool:
    """Return whether each argument of the constructor of a dataclass is a field, which an `InitVar` is not."""
    arguments = {item.name for item in fields(value) if item.init}
    return not _is_of_plugin(value) or arguments == set(inspect.signature(type(value)).parameters)


def _state(value: Any) -> Any:
    """Return what pickle stores of an object: the arguments of its construction and its attributes."""
    try:
        reduced = value.__reduce_ex__(2)
        if isinstance(reduced, str):  # a name in a module
            return [reduced, code_of(value.__module__)]
        return [as_plain(list(part) if isinstance(part, Iterator) else part) for part in reduced]
    except UserError:
        raise
    except Exception as error:  # objects raise errors of any type; RecursionError: they refer to each other
        raise _undescribed(type(value)) from error


def _named(item: Any) -> str:
    """Return the name of a class or function, followed by its code."""
    module = item.__module__ or "builtins"
    if "<" in item.__qualname__ and is_plugin(
        module
    ):  # depends on the variables of the function that defines it
        raise _undescribed(item)
    return f"{module}.{item.__qualname__} {code_of(module)}".rstrip()


def _undescribed(item: Any) -> UserError:
    return UserError(
        f"cache: got {item.__module__}.{item.__qualname__}, which cannot be part of the key of a cached result, "
        "expected plain values, or classes and functions at the top of a module; define it there"
    )


def _held_by(item: Any, module: str) -> Iterable[Any]:
    """Return the objects in a container, or in the attributes of an object of the core or of a plugin."""
    if isinstance(item, Mapping):
        return item.values()
    if isinstance(item, (list, tuple, Set)):
        return item
    if isinstance(item, partial):
        return [item.func, *item.args, *item.keywords.values()]
    if isinstance(item, type) or not (is_core(module) or is_plugin(module)):
        return []
    names = [field.name for field in fields(item)] if is_dataclass(item) else []
    return [*getattr(item, "__dict__", {}).values(), *(getattr(item, name, None) for name in names)]

"""References in configs from files: resolvers are refused, and so are references that expand to much data."""

import time
from typing import Any

import pytest
from omegaconf import OmegaConf

from imagination.config.references import MAX_SIZE, check_references
from imagination.utils.errors import UserError


def test_references_are_allowed() -> None:
    values = {"a": {"b": ["x", "y"], "c": "${.b}", "d": "${..e.1}-${a.b.0}"}, "e": "${a.b}", "f": "${a.c.0}"}
    check_references(values)
    assert OmegaConf.to_container(OmegaConf.create(values), resolve=True)["a"]["d"] == "y-x"  # type: ignore[index,call-overload]


@pytest.mark.parametrize(
    "text",
    [
        "${oc.env:HOME}",
        "${oc.decode:'{_target_: os.system}'}",
        "${ oc.env:HOME}",
        "a ${now:%Y} b",
        "${${a}}",
        "${a.${b}}",
        "${a[0]}",
        "${",
    ],
)
def test_resolvers_are_refused(text: str) -> None:
    with pytest.raises(UserError, match=r"got a value with .*\$\{"):
        check_references({"a": {"b": [text]}})


def doubling_texts(levels: int) -> dict[str, Any]:
    return {f"a{level}": f"${{a{level + 1}}}${{a{level + 1}}}" for level in range(levels)} | {
        f"a{levels}": ""
    }


def doubling_nodes(levels: int) -> dict[str, Any]:
    nodes: dict[str, Any] = {
        f"a{level}": {"x": f"${{a{level + 1}}}", "y": [f"${{a{level + 1}}}"]} for level in range(levels)
    }
    return nodes | {f"a{levels}": {}}


def doubling_through_a_parent(levels: int) -> dict[str, Any]:
    """Return values that double on the way to a key of a node that is a reference itself."""
    nodes: dict[str, Any] = {f"a{level}": {"k": f"${{b{level}.k}}${{b{level}.k}}"} for level in range(levels)}
    return nodes | {f"b{level}": f"${{a{level + 1}}}" for level in range(levels)} | {f"a{levels}": {"k": "x"}}


@pytest.mark.parametrize("bomb", [doubling_texts, doubling_nodes, doubling_through_a_parent])
def test_references_that_expand_to_much_data_are_refused(bomb: Any) -> None:
    check_references(bomb(5))
    start = time.process_time()
    with pytest.raises(UserError, match=str(MAX_SIZE)):
        check_references(bomb(60))
    assert time.process_time() - start < 1.0


def test_many_references_to_a_long_list_are_refused_quickly() -> None:
    values = {"list": [0] * 50_000, **{f"a{n}": "${list}" for n in range(50_000)}}
    start = time.process_time()
    with pytest.raises(UserError, match=str(MAX_SIZE)):
        check_references(values)
    assert time.process_time() - start < 20.0  # without the check, minutes


@pytest.mark.parametrize(
    "values",
    [
        {"a": "${a}"},
        {"a": "${b.c}", "b": "${a}"},
        {"a": {"b": "${a}"}},
        {f"a{n}": f"${{a{n + 1}}}" for n in range(20_000)},
        {f"a{n}": f"${{a{n + 1}.k}}" for n in range(20_000)},
    ],
)
def test_circular_and_deep_references_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(UserError, match="circular"):
        check_references(values)

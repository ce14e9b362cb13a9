"""The config that a run left, checked: it may have been edited, damaged, or come from a stranger."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imagination.utils.errors import UserError, check_range
from imagination.utils.tabular import read_yaml

KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("scale", "data", "data.scenes", "model"), (dict,)),
    **dict.fromkeys(("evaluation", "evaluation.approaches"), (dict,)),
    **dict.fromkeys(("evaluation.cell_widths", "unit_categories", "choices"), (list,)),
    "ckpt": (str, list),
}
"""Of the nodes that a report reads; each may be missing."""

RANGES: dict[str, tuple[float, float]] = {
    "scale.resolution": (0.005, 1.0),
    "evaluation.seed": (0, 2**63),
    "evaluation.resamples": (1, 10**9),
    "evaluation.viewpoint_sets": (0, 10_000),
}
"""Of the numbers that a report reads; each may be missing."""


def read_config(path: Path) -> dict[str, Any]:
    """A run's resolved config.

    Raises:
        UserError: if there is none, it is damaged, or holds what a report cannot go by.
    """
    if not path.is_file():
        raise UserError(
            f"report: got {path.parent}, expected the folder of a run, an evaluation or a sweep, which holds "
            f"{path.name} or numbered folders that do; such as outputs/chair_unet/latest"
        )
    config = read_yaml(path)
    for key, kinds in KINDS.items():
        value = at(config, key)
        if value is not None and not isinstance(value, kinds):
            expected = " or ".join(kind.__name__ for kind in kinds)
            raise UserError(f"config {path}: {key} is damaged: got {value!r}, expected {expected}")
    if other := [name for name in at(config, "unit_categories") or [] if not isinstance(name, str)]:
        raise UserError(f"config {path}: unit_categories is damaged: got {other[0]!r}, expected names")
    for key, (low, high) in RANGES.items():
        if (value := at(config, key)) is not None:
            check_number(f"config {path}: {key}", value, low, high)
    for width in at(config, "evaluation.cell_widths") or []:
        check_number(f"config {path}: evaluation.cell_widths", width, 0.0, 1e3)
    return config


def at(config: Mapping[str, Any], key: str) -> Any:
    """The value of a dotted key; None where it or a node above it is missing."""
    node: Any = config
    for name in key.split("."):
        node = node.get(name) if isinstance(node, Mapping) else None
    return node


def check_number(name: str, value: Any, low: float, high: float) -> None:
    """Check a value that came out of a file.

    Raises:
        UserError: if it is no number in the range.
    """
    if not isinstance(value, (int, float)):
        raise UserError(f"{name}: got {value!r}, expected a number")
    check_range(name, value, low, high)

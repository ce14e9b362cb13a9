"""Reader of a run's saved config, which is untrusted: edited, damaged or from another source."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imagination.utils.errors import UserError, check_range
from imagination.utils.tabular import read_yaml

KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("ego", "data", "data.scenes", "model"), (dict,)),
    **dict.fromkeys(("evaluation", "evaluation.approaches"), (dict,)),
    **dict.fromkeys(("evaluation.cell_widths", "unit_categories", "choices"), (list,)),
    "ckpt": (str, list),
}
"""Types of the nodes that a report reads; each node is optional."""

RANGES: dict[str, tuple[float, float]] = {
    "ego.resolution": (0.005, 1.0),
    "evaluation.seed": (0, 2**63),
    "evaluation.resamples": (1, 10**9),
    "evaluation.viewpoint_sets": (0, 10_000),
}
"""Ranges of the numbers that a report reads; each number is optional."""


def read_config(path: Path) -> dict[str, Any]:
    """Read and check a run's resolved config.

    Raises:
        UserError: if the file is missing or damaged, or a value has the wrong type or range.
    """
    if not path.is_file():
        raise UserError(
            f"folder: got {path.parent}, expected the folder of a run, an evaluation or a sweep, which contains "
            f"{path.name} or numbered folders with one; for example outputs/chair_unet/latest"
        )
    config = read_yaml(path)
    for key, kinds in KINDS.items():
        value = at(config, key)
        if value is not None and not isinstance(value, kinds):
            expected = " or ".join(kind.__name__ for kind in kinds)
            raise UserError(f"config {path}: {key} is damaged: got {value!r}, expected {expected}")
    if invalid := [name for name in at(config, "unit_categories") or [] if not isinstance(name, str)]:
        raise UserError(f"config {path}: unit_categories is damaged: got {invalid[0]!r}, expected names")
    for key, (low, high) in RANGES.items():
        if (value := at(config, key)) is not None:
            check_number(f"config {path}: {key}", value, low, high)
    for width in at(config, "evaluation.cell_widths") or []:
        check_number(f"config {path}: evaluation.cell_widths", width, 0.0, 1e3)
    return config


def at(config: Mapping[str, Any], key: str) -> Any:
    """Return the value of a dotted key; None if it or a parent node is missing."""
    node: Any = config
    for name in key.split("."):
        node = node.get(name) if isinstance(node, Mapping) else None
    return node


def check_number(name: str, value: Any, low: float, high: float) -> None:
    """Check a number from a file.

    Raises:
        UserError: if the value is not a number in the range.
    """
    if not isinstance(value, (int, float)):
        raise UserError(f"{name}: got {value!r}, expected a number")
    check_range(name, value, low, high)

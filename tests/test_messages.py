"""The exact text of important messages, in golden/messages.txt; all other tests match only keys and values.

After a message was changed on purpose, write the file anew: `python -m tests.test_messages`.
"""

import errno
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.config.renamed_keys import check_renamed
from imagination.config.trust import check_targets
from imagination.config.validation import validate
from imagination.geometry.grid import cells_of
from imagination.runs.checkpoint import Checkpoint
from imagination.runs.folder import find_latest
from imagination.runs.locking import locked
from imagination.utils.atomic_io import replacing
from imagination.utils.errors import UserError, check_choice, check_range, require_extra
from tests.conftest import ROOT

GOLDEN = ROOT / "tests" / "golden" / "messages.txt"


def train(*overrides: str) -> None:
    validate(compose("train", ["+experiment=chair_unet", "paths.run=.", *overrides]))


def full_disk(folder: Path) -> None:
    with replacing(folder / "table.csv"):
        raise OSError(errno.ENOSPC, "No space left on device")


def busy(folder: Path) -> None:
    with locked(folder), locked(folder):
        pass


CASES: dict[str, Callable[[Path], object]] = {
    "value out of range": lambda folder: train("data.workers=-1"),
    "list expected": lambda folder: train("evaluation.cell_widths=3.0"),
    "unknown category": lambda folder: train("unit_categories=[sofa]"),
    "unknown choice": lambda folder: check_choice("split", "testing", ("train", "val", "test")),
    "renamed key": lambda folder: check_renamed("train", ["scale.rounds=3"]),
    "renamed option": lambda folder: check_renamed("train", ["scale=desk"]),
    "no run to resume": lambda folder: find_latest(folder, "chair_unet"),
    "run in use": busy,
    "no such checkpoint": lambda folder: Checkpoint.read(folder / "best.ckpt"),
    "hostile config": lambda folder: check_targets(
        OmegaConf.create({"model": {"optimizer": {"_target_": "os.system"}}})
    ),
    "disk is full": full_disk,
    "missing extra": lambda folder: require_extra("no_such_package", "onnx"),
    "grid too large": lambda folder: cells_of(10_000.0, 0.005),
    "not a number": lambda folder: check_range("robot.radius", float("nan"), 0.0, 2.0, "m"),
}


def message(case: str, folder: Path) -> str:
    with pytest.raises(UserError) as error:
        CASES[case](folder)
    return str(error.value).replace(str(folder.resolve()), "FOLDER").replace(str(folder), "FOLDER")


def golden() -> dict[str, str]:
    blocks = GOLDEN.read_text().strip().split("\n\n")
    return dict(block.split("\n", 1) for block in blocks)


def test_every_message_is_in_the_golden_file() -> None:
    assert list(golden()) == list(CASES)


@pytest.mark.parametrize("case", CASES)
def test_message(case: str, tmp_path: Path) -> None:
    assert message(case, tmp_path) == golden()[case]


if __name__ == "__main__":
    with TemporaryDirectory() as scratch:
        GOLDEN.write_text("\n\n".join(f"{case}\n{message(case, Path(scratch))}" for case in CASES) + "\n")

"""Trained units from files, by what the files are; torch is imported only for those that need it."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from imagination.mapping.predictor import ImaginationModule, Observation, UnitEnsemble
from imagination.utils.errors import UserError


def load(units: str | Path | Sequence[str | Path]) -> ImaginationModule:
    """Load units from one file, or from several of different categories.

    Args:
        units: .onnx (runs on onnxruntime), .pt2 (torch.export) or .ckpt (a checkpoint of imagination.train).

    Raises:
        UserError: if a file is missing, broken or of another kind, what runs it is not installed, it does not answer as
            a unit does, or the units were trained with different cameras or grids.
    """
    paths = [units] if isinstance(units, (str, Path)) else list(units)
    if not paths:
        raise UserError("unit: got no file, expected at least one .onnx, .pt2 or .ckpt")
    modules = [_load(Path(path)) for path in paths]
    return modules[0] if len(modules) == 1 else UnitEnsemble(modules)


def _load(path: Path) -> ImaginationModule:
    loaders: dict[str, Callable[[Path], ImaginationModule]] = {
        ".onnx": _onnx,
        ".pt2": _exported,
        ".ckpt": _checkpoint,
    }
    if path.suffix not in loaders:
        raise UserError(f"unit: got {path}, expected a file that ends in one of: {', '.join(loaders)}")
    if not path.is_file():
        raise UserError(f"unit: got {path}, but there is no such file")
    return _answering(loaders[path.suffix](path), path)


def _answering(module: ImaginationModule, path: Path) -> ImaginationModule:
    """The same, after it answered once: a unit that cannot is refused here, not while a robot drives.

    Raises:
        UserError: if it cannot, or answers something else than a map of each category.
    """
    told, cells = module.spec, module.spec.ego.cells
    size = told.camera.height, told.camera.width
    nothing = np.zeros((cells, cells), np.bool_)
    blank = np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32), nothing, nothing
    try:
        answer = module(Observation(*blank, told.camera.mount_height))
    except Exception as error:  # whatever the broken part raises
        raise UserError(f"{path}: does not take what a robot sees ({error}); export it again") from error
    expected = np.dtype(np.float32), (len(told.categories), cells, cells)
    if (answer.dtype, answer.shape) != expected:
        raise UserError(
            f"{path}: answers {answer.dtype} of shape {answer.shape}, expected {expected[0]} of {expected[1]}; "
            "export it again"
        )
    return module


def _onnx(path: Path) -> ImaginationModule:
    from imagination.deployment.onnx_backend import OnnxModule

    return OnnxModule(path)


def _exported(path: Path) -> ImaginationModule:
    from imagination.deployment.torch_backend import ExportedModule

    return ExportedModule(path)


def _checkpoint(path: Path) -> ImaginationModule:
    from imagination.deployment.torch_backend import CheckpointModule

    return CheckpointModule(path)

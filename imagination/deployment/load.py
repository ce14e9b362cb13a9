"""Loading of trained units from files; torch is imported only for the formats that need it."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from imagination.mapping.predictor import MapPredictor, Observation, UnitEnsemble
from imagination.utils.errors import UserError


def load(units: str | Path | Sequence[str | Path]) -> MapPredictor:
    """Load units from one file, or from several of different categories.

    Args:
        units: path or paths of .onnx (runs on onnxruntime), .pt2 (torch.export) or .ckpt files (checkpoints of
            imagination.train).

    Raises:
        UserError: if a file is missing, damaged or of another kind, its runtime is not installed, its prediction is not
            that of a unit, or the units were trained with different cameras or grids.
    """
    paths = [units] if isinstance(units, (str, Path)) else list(units)
    if not paths:
        raise UserError("unit: got no file, expected at least one .onnx, .pt2 or .ckpt")
    predictors = [_load(Path(path)) for path in paths]
    return predictors[0] if len(predictors) == 1 else UnitEnsemble(predictors)


def _load(path: Path) -> MapPredictor:
    loaders: dict[str, Callable[[Path], MapPredictor]] = {
        ".onnx": _onnx,
        ".pt2": _exported,
        ".ckpt": _checkpoint,
    }
    if path.suffix not in loaders:
        raise UserError(f"unit: got {path}, expected a file with one of the suffixes {', '.join(loaders)}")
    if not path.is_file():
        raise UserError(f"unit: got {path}, but there is no such file")
    return _checked(loaders[path.suffix](path), path)


def _checked(predictor: MapPredictor, path: Path) -> MapPredictor:
    """Return the predictor after one prediction of a blank observation, so that a broken file fails at loading time.

    Raises:
        UserError: if the prediction fails or is not one map per category.
    """
    spec, cells = predictor.spec, predictor.spec.ego.cells
    size = spec.camera.height, spec.camera.width
    empty = np.zeros((cells, cells), np.bool_)
    blank = np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32), empty, empty
    try:
        prediction = predictor(Observation(*blank, spec.camera.mount_height))
    except Exception as error:  # the type depends on the damaged part
        raise UserError(
            f"{path}: prediction of a blank observation failed ({error}); export it again"
        ) from error
    expected = np.dtype(np.float32), (len(spec.categories), cells, cells)
    if (prediction.dtype, prediction.shape) != expected:
        raise UserError(
            f"{path}: got a prediction of {prediction.dtype} of shape {prediction.shape}, expected {expected[0]} of "
            f"{expected[1]}; export it again"
        )
    return predictor


def _onnx(path: Path) -> MapPredictor:
    from imagination.deployment.onnx_backend import OnnxModule

    return OnnxModule(path)


def _exported(path: Path) -> MapPredictor:
    from imagination.deployment.torch_backend import ExportedModule

    return ExportedModule(path)


def _checkpoint(path: Path) -> MapPredictor:
    from imagination.deployment.torch_backend import CheckpointModule

    return CheckpointModule(path)

"""Trained units from files, by what the files are; torch is imported only for those that need it."""

from collections.abc import Callable, Sequence
from pathlib import Path

from imagination.errors import UserError
from imagination.mapping.module import ImaginationModule, SideBySide


def load(units: str | Path | Sequence[str | Path]) -> ImaginationModule:
    """Load units from one file, or from several of different categories.

    Args:
        units: .onnx (runs on onnxruntime), .pt2 (torch.export) or .ckpt (a checkpoint of imagination.train).

    Raises:
        UserError: if a file is missing, broken or of another kind, what runs it is not installed, or the units were
            trained with different cameras or grids.
    """
    paths = [units] if isinstance(units, (str, Path)) else list(units)
    if not paths:
        raise UserError("unit: got no file, expected at least one .onnx, .pt2 or .ckpt")
    modules = [_load(Path(path)) for path in paths]
    return modules[0] if len(modules) == 1 else SideBySide(modules)


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
    return loaders[path.suffix](path)


def _onnx(path: Path) -> ImaginationModule:
    from imagination.deployment.onnx_module import OnnxModule

    return OnnxModule(path)


def _exported(path: Path) -> ImaginationModule:
    from imagination.deployment.torch_module import ExportedModule

    return ExportedModule(path)


def _checkpoint(path: Path) -> ImaginationModule:
    from imagination.deployment.torch_module import CheckpointModule

    return CheckpointModule(path)

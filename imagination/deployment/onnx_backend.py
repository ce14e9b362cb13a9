"""Units that run on onnxruntime, without torch."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from imagination.mapping.predictor import Observation, UnitSpec
from imagination.utils.errors import UserError, require_extra

KEY = "imagination"
"""Of our description in the file's metadata."""

NAMES = ("rgb", "depth", "occupied", "seen", "mount_height")
"""Of the inputs, in order."""


class OnnxModule:
    """An .onnx file of imagination.export.

    Args:
        path: of the file.
        threads: of one frame; all cores if 0.

    Raises:
        UserError: if onnxruntime is not installed, or the file is broken or not ours.
    """

    def __init__(self, path: Path, threads: int = 0) -> None:
        require_extra("onnxruntime", "onnx")
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        try:  # from memory: such a file cannot refer to others
            self._session = onnxruntime.InferenceSession(
                path.read_bytes(), options, providers=["CPUExecutionProvider"]
            )
            metadata = self._session.get_modelmeta().custom_metadata_map
            self._inputs = {node.name for node in self._session.get_inputs()}
        except Exception as error:  # onnxruntime exports no common type of its own
            raise UserError(f"{path}: cannot be read as ONNX ({error}); export it again") from error
        if KEY not in metadata:
            raise UserError(f"{path}: was not written by imagination.export")
        self.spec = UnitSpec.from_json(metadata[KEY], str(path))

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        feed = {name: array for name, array in arrays(observation).items() if name in self._inputs}
        probabilities: np.ndarray = self._session.run(None, feed)[0][0]
        return probabilities


def arrays(observation: Observation) -> dict[str, np.ndarray]:
    """An observation as a unit takes it: a batch of one, with the types that training gave it."""
    values = (
        np.ascontiguousarray(observation.rgb.transpose(2, 0, 1)[None]),
        observation.depth.astype(np.float16)[None, None],
        observation.occupied.astype(np.uint8)[None, None],
        observation.seen.astype(np.uint8)[None, None],
        np.array(observation.mount_height, np.float32),
    )
    return dict(zip(NAMES, values, strict=True))

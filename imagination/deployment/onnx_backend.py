"""Inference of exported units with onnxruntime, without torch."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from imagination.mapping.predictor import Observation, UnitSpec
from imagination.utils.errors import UserError, require_extra

KEY = "imagination"
"""Metadata key of the unit specification."""

NAMES = ("rgb", "depth", "occupied", "seen", "mount_height")
"""Names of the inputs, in order."""


class OnnxModule:
    """Predictor of an .onnx file of imagination.export.

    Args:
        path: path of the file.
        threads: number of threads per prediction; all cores if 0.

    Raises:
        UserError: if onnxruntime is not installed, or the file is damaged or was not written by imagination.export.
    """

    def __init__(self, path: Path, threads: int = 0) -> None:
        require_extra("onnxruntime", "onnx")
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        try:  # a model in memory cannot refer to external files
            self._session = onnxruntime.InferenceSession(
                path.read_bytes(), options, providers=["CPUExecutionProvider"]
            )
            metadata = self._session.get_modelmeta().custom_metadata_map
            self._inputs = {node.name for node in self._session.get_inputs()}
        except Exception as error:  # onnxruntime has no public base class of its errors
            raise UserError(f"{path}: cannot be read as ONNX ({error}); export it again") from error
        if KEY not in metadata:
            raise UserError(f"{path}: was not written by imagination.export, got no metadata {KEY!r}")
        self.spec = UnitSpec.from_json(metadata[KEY], str(path))

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        feed = {name: array for name, array in arrays(observation).items() if name in self._inputs}
        probabilities: np.ndarray = self._session.run(None, feed)[0][0]
        return probabilities


def arrays(observation: Observation) -> dict[str, np.ndarray]:
    """Convert an observation to the inputs of a unit: a batch of one with the data types of training."""
    values = (
        np.ascontiguousarray(observation.rgb.transpose(2, 0, 1)[None]),
        observation.depth.astype(np.float16)[None, None],
        observation.occupied.astype(np.uint8)[None, None],
        observation.seen.astype(np.uint8)[None, None],
        np.array(observation.mount_height, np.float32),
    )
    return dict(zip(NAMES, values, strict=True))

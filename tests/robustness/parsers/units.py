"""Parsers of networks: exported units, and the public weights of HRNetV2."""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn

from imagination.deployment.load import load
from imagination.deployment.onnx_backend import KEY, NAMES, arrays
from imagination.deployment.torch_backend import ENTRY, inputs
from imagination.mapping.predictor import UnitSpec
from imagination.models.segmentation.ade20k import fill, read, renamed
from tests.helpers.checkpoints import samples
from tests.helpers.toy_units import EGO, Toy
from tests.robustness.parsers.parser import Parser, resealed, temporary_folder, with_file_replaced

TEXT = Toy("chair", "bed").spec.to_json()


class Half(nn.Module):
    """Unit for two categories without weights, so that damage hits the program."""

    def forward(
        self, rgb: Tensor, depth: Tensor, occupied: Tensor, seen: Tensor, mount_height: Tensor
    ) -> Tensor:
        return torch.cat([0.5 * occupied, 0.25 * seen], dim=1) * mount_height


def exported(folder: Path) -> None:
    """Write the unit `Half` with torch.export."""
    folder.mkdir()
    program = torch.export.export(Half(), inputs(samples(1)[0].observation))
    torch.export.save(program, folder / "unit.pt2", extra_files={ENTRY: TEXT})


def as_onnx(folder: Path) -> None:
    """Write the unit `Half` as ONNX."""
    import onnx
    from onnx import TensorProto, helper

    folder.mkdir()
    inputs_ = arrays(samples(1)[0].observation)
    types = {name: helper.np_dtype_to_tensor_dtype(array.dtype) for name, array in inputs_.items()}
    graph_inputs = [helper.make_tensor_value_info(name, types[name], inputs_[name].shape) for name in NAMES]
    size = [1, 2, EGO.cells, EGO.cells]
    graph_output = helper.make_tensor_value_info("probabilities", TensorProto.FLOAT, size)
    nodes = [
        helper.make_node("Concat", ["occupied", "seen"], ["both"], axis=1),
        helper.make_node("Cast", ["both"], ["numbers"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["numbers", "factor"], ["part"]),
        helper.make_node("Mul", ["part", "mount_height"], ["probabilities"]),
    ]
    factor = helper.make_tensor("factor", TensorProto.FLOAT, [1, 2, 1, 1], [0.5, 0.25])
    graph = helper.make_graph(nodes, "unit", graph_inputs, [graph_output], [factor])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    helper.set_model_props(model, {KEY: TEXT})
    onnx.save(model, folder / "unit.onnx")


def predict(file: str) -> Callable[[Path], object]:
    """Return a function that loads a unit of a folder and predicts once."""
    return lambda folder: load(folder / file)(samples(1)[0].observation)


class Tiny(nn.Module):
    """Network with a few layers of HRNetV2 under their original names."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.ModuleDict({"conv1": nn.Conv2d(1, 1, 1, bias=False), "bn1": nn.BatchNorm2d(1)})
        head = nn.Sequential(nn.Conv2d(1, 1, 1, bias=False), nn.BatchNorm2d(1))
        self.decoder = nn.Sequential(head, nn.Conv2d(1, 2, 1))


def public_weights(folder: Path) -> None:
    """Write the weights of `Tiny` in the layout of the public release."""
    folder.mkdir()
    encoder, decoder = (part.state_dict() for part in Tiny().children())
    public_names = {"0.": "cbr.", "1.": "conv_last."}
    torch.save(encoder, folder / "encoder_epoch_30.pth")
    torch.save(
        {public_names[name[:2]] + name[2:]: tensor for name, tensor in decoder.items()},
        folder / "decoder_epoch_30.pth",
    )


def load_public_weights(folder: Path) -> object:
    """Load the public weights into `Tiny`."""
    return fill(Tiny(), renamed(read(folder, "encoder"), read(folder, "decoder")), folder)


WEIGHTS, PROGRAM, ONNX = (
    temporary_folder(public_weights),
    temporary_folder(exported),
    temporary_folder(as_onnx),
)

PARSERS = [
    Parser("ade20k-encoder", *with_file_replaced(WEIGHTS, "encoder_epoch_30.pth", load_public_weights)),
    Parser(
        "ade20k-encoder-resealed",
        *resealed(*with_file_replaced(WEIGHTS, "encoder_epoch_30.pth", load_public_weights)),
    ),
    Parser("ade20k-decoder", *with_file_replaced(WEIGHTS, "decoder_epoch_30.pth", load_public_weights)),
    Parser(
        "ade20k-decoder-resealed",
        *resealed(*with_file_replaced(WEIGHTS, "decoder_epoch_30.pth", load_public_weights)),
    ),
    Parser("pt2", *with_file_replaced(PROGRAM, "unit.pt2", predict("unit.pt2"))),
    Parser("pt2-resealed", *resealed(*with_file_replaced(PROGRAM, "unit.pt2", predict("unit.pt2")))),
    Parser(
        "onnx-description",
        lambda path: UnitSpec.from_json(path.read_text(errors="replace"), str(path)),
        lambda: [TEXT.encode()],
    ),
]
if find_spec("onnx") is not None and find_spec("onnxruntime") is not None:  # an optional extra
    PARSERS.append(Parser("onnx", *with_file_replaced(ONNX, "unit.onnx", predict("unit.onnx"))))

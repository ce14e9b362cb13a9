"""Parsers of trained networks: exported units, and the public weights of HRNetV2."""

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
from tests.robustness.parsers.parser import Parser, exchanged, kept, resealed

TEXT = Toy("chair", "bed").spec.to_json()


class Half(nn.Module):
    """Of what is occupied, for two categories: a unit of so little that damage meets what matters."""

    def forward(
        self, rgb: Tensor, depth: Tensor, occupied: Tensor, seen: Tensor, mount_height: Tensor
    ) -> Tensor:
        return torch.cat([0.5 * occupied, 0.25 * seen], dim=1) * mount_height


def exported(folder: Path) -> None:
    """Write Half as a program of torch.export."""
    folder.mkdir()
    program = torch.export.export(Half(), inputs(samples(1)[0].observation))
    torch.export.save(program, folder / "unit.pt2", extra_files={ENTRY: TEXT})


def as_onnx(folder: Path) -> None:
    """Write the same as ONNX."""
    import onnx
    from onnx import TensorProto, helper

    folder.mkdir()
    given = arrays(samples(1)[0].observation)
    types = {name: helper.np_dtype_to_tensor_dtype(array.dtype) for name, array in given.items()}
    takes = [helper.make_tensor_value_info(name, types[name], given[name].shape) for name in NAMES]
    size = [1, 2, EGO.cells, EGO.cells]
    gives = helper.make_tensor_value_info("probabilities", TensorProto.FLOAT, size)
    nodes = [
        helper.make_node("Concat", ["occupied", "seen"], ["both"], axis=1),
        helper.make_node("Cast", ["both"], ["numbers"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["numbers", "share"], ["part"]),
        helper.make_node("Mul", ["part", "mount_height"], ["probabilities"]),
    ]
    share = helper.make_tensor("share", TensorProto.FLOAT, [1, 2, 1, 1], [0.5, 0.25])
    graph = helper.make_graph(nodes, "unit", takes, [gives], [share])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    helper.set_model_props(model, {KEY: TEXT})
    onnx.save(model, folder / "unit.onnx")


def asked(file: str) -> Callable[[Path], object]:
    """What loads a unit of a folder and asks it once."""
    return lambda folder: load(folder / file)(samples(1)[0].observation)


class Tiny(nn.Module):
    """Parts that HRNetV2 has, with the names it has."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.ModuleDict({"conv1": nn.Conv2d(1, 1, 1, bias=False), "bn1": nn.BatchNorm2d(1)})
        head = nn.Sequential(nn.Conv2d(1, 1, 1, bias=False), nn.BatchNorm2d(1))
        self.decoder = nn.Sequential(head, nn.Conv2d(1, 2, 1))


def public_weights(folder: Path) -> None:
    """Write its weights as the public release has them."""
    folder.mkdir()
    encoder, decoder = (part.state_dict() for part in Tiny().children())
    theirs = {"0.": "cbr.", "1.": "conv_last."}
    torch.save(encoder, folder / "encoder_epoch_30.pth")
    torch.save(
        {theirs[name[:2]] + name[2:]: each for name, each in decoder.items()}, folder / "decoder_epoch_30.pth"
    )


def filled(folder: Path) -> object:
    """Read them."""
    return fill(Tiny(), renamed(read(folder, "encoder"), read(folder, "decoder")), folder)


WEIGHTS, PROGRAM, ONNX = kept(public_weights), kept(exported), kept(as_onnx)

PARSERS = [
    Parser("ade20k-encoder", *exchanged(WEIGHTS, "encoder_epoch_30.pth", filled)),
    Parser("ade20k-encoder-resealed", *resealed(*exchanged(WEIGHTS, "encoder_epoch_30.pth", filled))),
    Parser("ade20k-decoder", *exchanged(WEIGHTS, "decoder_epoch_30.pth", filled)),
    Parser("ade20k-decoder-resealed", *resealed(*exchanged(WEIGHTS, "decoder_epoch_30.pth", filled))),
    Parser("pt2", *exchanged(PROGRAM, "unit.pt2", asked("unit.pt2"))),
    Parser("pt2-resealed", *resealed(*exchanged(PROGRAM, "unit.pt2", asked("unit.pt2")))),
    Parser(
        "onnx-description",
        lambda path: UnitSpec.from_json(path.read_text(errors="replace"), str(path)),
        lambda: [TEXT.encode()],
    ),
]
if find_spec("onnx") is not None and find_spec("onnxruntime") is not None:  # an optional extra
    PARSERS.append(Parser("onnx", *exchanged(ONNX, "unit.onnx", asked("unit.onnx"))))

"""Public weights: every tensor of the release's layout is loaded into its place."""

import zipfile
from pathlib import Path

import pytest
import torch
from torch import Tensor

from imagination.config.compose import compose
from imagination.geometry.camera import Camera
from imagination.models.segmentation.ade20k import CLASSES, PublicHRNet, read
from imagination.scenes.categories import CategoryTable
from imagination.utils.errors import UserError

CAMERA = Camera.from_degrees(64, 48, 90.0, 1.25)
WIDTHS = (48, 96, 192, 384)

Shapes = dict[str, tuple[int, ...]]


def convolution(name: str, inputs: int, outputs: int, kernel: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs, kernel, kernel)}


def normalisation(name: str, channels: int) -> Shapes:
    counted = "weight", "bias", "running_mean", "running_var", "_tmp_running_mean", "_tmp_running_var"
    return {**{f"{name}.{part}": (channels,) for part in counted}, f"{name}._running_iter": (1,)}


def pair(name: str, inputs: int, outputs: int, kernel: int = 3) -> Shapes:
    """Return the shapes of a convolution and a normalisation at the start of a sequence."""
    return convolution(f"{name}.0", inputs, outputs, kernel) | normalisation(f"{name}.1", outputs)


def encoder() -> Shapes:
    """Return the shapes of HRNetV2-W48: stem, 4 bottlenecks, stages of 1, 4 and 3 modules with 2, 3 and 4 branches."""
    shapes: Shapes = {}
    for number, inputs in ((1, 3), (2, 64)):
        shapes |= convolution(f"conv{number}", inputs, 64, 3) | normalisation(f"bn{number}", 64)
    for block in range(4):
        sizes = ((256 if block else 64), 64, 1), (64, 64, 3), (64, 256, 1)
        for number, (inputs, outputs, kernel) in enumerate(sizes, 1):
            shapes |= convolution(f"layer1.{block}.conv{number}", inputs, outputs, kernel)
            shapes |= normalisation(f"layer1.{block}.bn{number}", outputs)
    shapes |= pair("layer1.0.downsample", 64, 256, 1)
    shapes |= pair("transition1.0", 256, 48) | pair("transition1.1.0", 256, 96)
    shapes |= pair("transition2.2.0", 96, 192) | pair("transition3.3.0", 192, 384)
    for stage, modules in ((2, 1), (3, 4), (4, 3)):
        for module in range(modules):
            for branch in range(stage):
                for block in range(4):
                    for number in (1, 2):
                        name = f"stage{stage}.{module}.branches.{branch}.{block}"
                        shapes |= convolution(f"{name}.conv{number}", WIDTHS[branch], WIDTHS[branch], 3)
                        shapes |= normalisation(f"{name}.bn{number}", WIDTHS[branch])
                for other in range(stage):
                    name = f"stage{stage}.{module}.fuse_layers.{branch}.{other}"
                    if other > branch:  # from a coarser branch
                        shapes |= pair(name, WIDTHS[other], WIDTHS[branch], 1)
                    for step in range(branch - other):  # from a finer one, halved step by step
                        last = step == branch - other - 1
                        shapes |= pair(f"{name}.{step}", WIDTHS[other], WIDTHS[branch if last else other])
    return shapes


def decoder(classes: int = 150) -> Shapes:
    head = {"conv_last.weight": (classes, 180, 1, 1), "conv_last.bias": (classes,)}
    return pair("cbr", sum(WIDTHS), 180) | head


def write(folder: Path, part: str, shapes: Shapes, first: int = 0, prefix: str = "") -> dict[str, Tensor]:
    """Write a file of the layout in which each tensor is filled with a unique number."""
    state = {
        prefix + name: torch.tensor(float(number)).expand(shape)
        for number, (name, shape) in enumerate(shapes.items(), first)
    }
    torch.save(state, folder / f"{part}_epoch_30.pth")
    return state


def table() -> CategoryTable:
    config = compose("train", ["paths.run=."])
    return CategoryTable.from_config({name: dict(row) for name, row in config.categories.items()})


def test_every_tensor_gets_its_place(tmp_path: Path) -> None:
    given = (
        write(tmp_path, "encoder", encoder()),
        write(tmp_path, "decoder", decoder(), 5000, prefix="module."),
    )
    network = PublicHRNet.load(tmp_path, table(), CAMERA).network
    ours = {**dict(network.named_parameters()), **dict(network.named_buffers())}
    for name, value in given[0].items():
        if not name.endswith(("_tmp_running_mean", "_tmp_running_var", "_running_iter")):
            assert torch.equal(ours.pop(f"encoder.{name}"), value), name
    for name, place in (("cbr.0", "decoder.0.0"), ("cbr.1", "decoder.0.1"), ("conv_last", "decoder.1")):
        for part in ("weight", "bias", "running_mean", "running_var"):
            if (value := given[1].get(f"module.{name}.{part}")) is not None:
                assert torch.equal(ours.pop(f"{place}.{part}"), value), name
    remaining = {name for name in ours if not name.endswith("num_batches_tracked")}
    assert remaining == {"mean", "deviation"}  # no other tensor keeps its random weights


class Sure(torch.nn.Module):
    """Network that predicts chair, bed, wall and swivel chair; for a mirrored image only walls."""

    def forward(self, rgb: Tensor) -> Tensor:
        pixels = 20 * torch.eye(150)[[19, 7, 0, 75]].T.reshape(1, 150, 2, 2)
        walls = 50 * torch.eye(150)[[0] * 4].T.reshape(1, 150, 2, 2)
        return walls if rgb[0, 0, 0, 0] > rgb[0, 0, 0, 1] else pixels


class Torn(torch.nn.Module):
    """Network that predicts a wall with 0.4 and three kinds of chairs with 0.6 in one pixel, 0.6 and 0.4 in another."""

    def forward(self, rgb: Tensor) -> Tensor:
        probabilities = torch.full((1, 150, 1, 2), 1e-6)
        probabilities[0, [0, 19, 30, 75], 0, 0] = torch.tensor([0.4, 0.2, 0.2, 0.2])
        probabilities[0, [0, 19, 30, 75], 0, 1] = torch.tensor([0.6, 0.2, 0.1, 0.1])
        return probabilities.log()


def test_classes_become_categories() -> None:
    assert len(CLASSES) == len(set(CLASSES)) == 150
    # as in the list of the benchmark, which counts from 1
    assert [CLASSES.index(name) + 1 for name in ("bed", "table", "chair", "armchair", "desk")] == [
        8,
        16,
        20,
        31,
        34,
    ]
    assert [CLASSES.index(name) + 1 for name in ("coffee_table", "swivel_chair", "stool")] == [65, 76, 111]
    network = PublicHRNet(table(), CAMERA)
    assert network.categories == ["chair", "bed", "table"]
    categories = {
        CLASSES[index]: int(value) for index, value in enumerate(network.category_of_class) if value
    }
    assert categories == {
        "chair": 1, "armchair": 1, "swivel_chair": 1, "bed": 2, "table": 3, "desk": 3, "coffee_table": 3,
    }  # fmt: skip
    network.network, image = Sure(), torch.tensor([[0, 9], [0, 9]], dtype=torch.uint8).expand(1, 3, 2, 2)
    assert network.segment(image, 2, 2).tolist() == [[[1, 2], [0, 1]]]
    network.tta_hflip = True
    assert network.segment(image, 2, 2).tolist() == [[[0, 0], [0, 0]]]


def test_probabilities_of_the_classes_of_a_category_are_added() -> None:
    network = PublicHRNet(table(), CAMERA)
    network.network = Torn()
    assert network.segment(torch.zeros(1, 3, 1, 2, dtype=torch.uint8), 1, 2).tolist() == [[[1, 0]]]


@pytest.mark.parametrize(
    ("part", "shapes", "message"),
    [
        ("decoder", decoder(19), r"decoder\.1\.weight: got \(19, 180, 1, 1\), expected \(150, 180, 1, 1\)"),
        (
            "encoder",
            {"conv1.weight": (64, 3, 7, 7)},
            r"encoder\.conv1\.weight: got \(64, 3, 7, 7\), expected \(64,",
        ),
        (
            "encoder",
            encoder() | {"fc.weight": (1000, 2048)},
            r"encoder\.fc\.weight: got \(1000, 2048\), expected none",
        ),
    ],
)
def test_weights_of_another_architecture_are_refused_by_name(
    tmp_path: Path, part: str, shapes: Shapes, message: str
) -> None:
    for name, entries in {"encoder": encoder(), "decoder": decoder(), part: shapes}.items():
        write(tmp_path, name, entries)
    with pytest.raises(UserError, match=message) as caught:
        PublicHRNet.load(tmp_path, table(), CAMERA)
    assert "HRNetV2-W48" in str(caught.value)
    assert str(caught.value).count("expected (") + str(caught.value).count("expected none") <= 3


def test_missing_files_and_files_without_weights_are_refused(tmp_path: Path) -> None:
    write(tmp_path, "encoder", {"conv1.weight": (1,)})
    with pytest.raises(UserError, match=r"ade20k: got none .*decoder_\*\.pth"):
        PublicHRNet.load(tmp_path, table(), CAMERA)
    torch.save({"weights": Path("x")}, tmp_path / "decoder_epoch_30.pth")
    with pytest.raises(UserError, match="ade20k: .*decoder_epoch_30.pth"):
        PublicHRNet.load(tmp_path, table(), CAMERA)


@pytest.mark.parametrize("part", ["encoder", "decoder"])
def test_damage_that_torch_does_not_handle_is_refused(tmp_path: Path, part: str) -> None:
    """The reader of torch then raises IndexError, AssertionError and others, while checksums of the archive match."""
    write(tmp_path, part, {"conv1.weight": (1,)})
    path = tmp_path / f"{part}_epoch_30.pth"
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    place = next(name for name in members if name.endswith("data.pkl"))
    content = members[place]
    for damaged in (content[2:3] + content[1:], b"e" + content, content[:-40] + content[-39:], b""):
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in {**members, place: damaged}.items():
                archive.writestr(name, data)
        with pytest.raises(UserError, match=f"{part}_epoch_30.pth"):
            read(tmp_path, part)


def test_keys_that_are_not_strings_are_refused(tmp_path: Path) -> None:
    torch.save({1: torch.zeros(1)}, tmp_path / "encoder_epoch_30.pth")
    with pytest.raises(UserError, match="ade20k: .*encoder_epoch_30.pth"):
        read(tmp_path, "encoder")


def test_a_class_that_does_not_exist_is_refused() -> None:
    rows = {"chair": {"colour": [0, 0, 0], "aliases": {"ade20k": ["swivel chair"]}}}
    with pytest.raises(UserError, match="chair.*ade20k.*got 'swivel chair'"):
        PublicHRNet(CategoryTable.from_config(rows), CAMERA)
    with pytest.raises(UserError, match=r"categories: got no row.*aliases\.ade20k"):
        PublicHRNet(CategoryTable.from_config({"chair": {"colour": [0, 0, 0]}}), CAMERA)

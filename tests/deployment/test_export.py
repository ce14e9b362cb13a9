"""Exported units answer as PyTorch does, on real views, and run without torch."""

import json
import logging
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.deployment.export import Sample, compare, export, sample_views
from imagination.deployment.load import load
from imagination.deployment.torch_backend import CheckpointModule, inputs
from imagination.mapping.predictor import Observation
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.runs.checkpoint import KEY, Checkpoint, ConfigInCheckpoint
from imagination.utils.errors import UserError
from tests.conftest import ROOT, Command
from tests.helpers.checkpoints import make_checkpoint, samples
from tests.helpers.toy_units import CAMERA, EGO, Toy
from tests.mapping.test_semantic_mapper import frames


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """chair.ckpt, bed.ckpt (of another variant), chair.onnx, both.onnx and both.pt2."""
    folder = tmp_path_factory.mktemp("units")
    chair = Checkpoint.read(make_checkpoint(folder / "chair.ckpt", threshold=0.8))
    bed = Checkpoint.read(
        make_checkpoint(folder / "bed.ckpt", "model=projected", "unit_categories=[bed]", threshold=0.65)
    )
    views = samples(2)
    export([chair], folder / "chair.onnx", "onnx", "float32", views)
    export([chair, bed], folder / "both.onnx", "onnx", "float32", views)
    export([chair, bed], folder / "both.pt2", "torch_export", "float32", views)
    return folder


@pytest.mark.parametrize("name", ["both.onnx", "both.pt2"])
def test_it_answers_as_pytorch(files: Path, name: str) -> None:
    module, reference = load(files / name), load([files / "chair.ckpt", files / "bed.ckpt"])
    assert module.spec == reference.spec
    assert module.spec.categories == ("chair", "bed")
    views = samples(6, categories=2)
    check = compare(module, reference, views)
    assert check.difference < 1e-4
    answers = np.stack([module(view.observation) for view in views])
    assert answers.min() < 0.4 and answers.max() > 0.6 and answers[0].std() > 0.02
    for channel in range(2):  # each of them looks at heights above the floor, which move with the camera
        lower = views[0].observation._replace(mount_height=0.9)
        np.testing.assert_allclose(module(lower), reference(lower), atol=1e-4)
        assert np.abs(module(lower) - module(views[0].observation))[channel].max() > 1e-3


def test_a_unit_may_look_once(tmp_path: Path) -> None:
    file, views = make_checkpoint(tmp_path / "chair.ckpt", "scale.postprocess_dilation=0"), samples(3)
    chair = Checkpoint.read(file)
    assert chair.config.scale.tta_hflip
    export([chair], tmp_path / "once.onnx", "onnx", "float32", views, look_once=True)
    export([chair], tmp_path / "twice.onnx", "onnx", "float32", views)
    files = tmp_path / "once.onnx", tmp_path / "twice.onnx"
    assert [told_by(each)["look_once"] for each in files] == [True, False]
    once, twice = map(load, files)
    assert compare(once, CheckpointModule(file, look_once=True), views).difference < 1e-4
    for view in views:
        own = view.observation
        mirror = own._replace(
            **{
                name: np.ascontiguousarray(getattr(own, name)[:, ::-1])
                for name in ("rgb", "depth", "occupied", "seen")
            }
        )
        logits = [np.log(answer / (1 - answer)) for answer in (once(own), once(mirror)[..., ::-1])]
        both = 1 / (1 + np.exp(-np.mean(logits, axis=0)))
        np.testing.assert_allclose(twice(own), both, atol=1e-4)
        assert np.abs(twice(own) - once(own)).max() > 1e-3


def told_by(file: Path) -> dict[str, Any]:
    metadata = {entry.key: entry.value for entry in onnx.load(file).metadata_props}
    return json.loads(metadata["imagination"])


def test_what_the_file_says_of_itself(files: Path) -> None:
    told = told_by(files / "both.onnx")
    assert told["categories"] == ["chair", "bed"] and told["precision"] == "float32"
    assert told["thresholds"] == [0.8, 0.65]  # what their validations chose
    assert told["ego"] == {"resolution": EGO.resolution, "cells": EGO.cells}
    assert told["camera"]["width"] == CAMERA.width and told["camera"]["mount_height"] == 1.25
    np.testing.assert_allclose(
        told["normalisation"][0]["mean"], 255 * np.array([0.485, 0.456, 0.406]), rtol=1e-5
    )


def test_it_maps_as_the_checkpoint_does(files: Path) -> None:
    ours, theirs = SemanticMapper(load(files / "chair.onnx")), SemanticMapper(load(files / "chair.ckpt"))
    for frame in frames():
        ours.update(*frame)
        theirs.update(*frame)
    np.testing.assert_allclose(ours.maps.probabilities, theirs.maps.probabilities, atol=1e-3)
    assert ours.maps.thresholds == theirs.maps.thresholds == (0.8,)
    assert SemanticMapper(load(files / "both.onnx")).spec.thresholds == (0.8, 0.65)


WITHOUT_TORCH = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "hydra", "lightning", "omegaconf", "timm"):
            raise ImportError("blocked: " + name)
sys.meta_path.insert(0, Block())
import numpy as np
from imagination.deployment.load import load
from imagination.geometry.pose import Pose
from imagination.mapping.predictor import Observation
from imagination.mapping.semantic_mapper import SemanticMapper
mapper = SemanticMapper(load(sys.argv[1]))
mapper.update(np.full((48, 48, 3), 90, np.uint8), np.full((48, 48), 2.0, np.float32), Pose(0.0, 0.0, 0.5))
mapper.save(sys.argv[2])
assert "torch" not in sys.modules
try:
    load(sys.argv[1].replace("onnx", "ckpt"))
except ImportError as error:
    print(error)
"""


def test_onnx_needs_no_torch(files: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, str(files / "chair.onnx"), str(tmp_path / "map")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("blocked: ")  # the block works
    assert (tmp_path / "map" / "map.yaml").is_file()


def test_what_is_no_unit_is_refused(files: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.onnx"
    broken.write_bytes((files / "chair.onnx").read_bytes()[:5000])
    (tmp_path / "noise.pt2").write_bytes(bytes(1000))
    strange = onnx.load(files / "chair.onnx")
    del strange.metadata_props[:]
    onnx.save(strange, tmp_path / "strange.onnx")
    for path, told in (
        (broken, "cannot be read as ONNX"),
        (tmp_path / "noise.pt2", "cannot be read as a program of torch.export"),
        (tmp_path / "strange.onnx", "was not written by imagination.export"),
        (tmp_path / "none.onnx", "there is no such file"),
        (tmp_path / "unit.pth", "expected a file that ends in one of: .onnx, .pt2, .ckpt"),
    ):
        with pytest.raises(UserError, match=told):
            load(path)
    with pytest.raises(UserError, match="expected at least one"):
        load([])
    with pytest.raises(UserError, match="got the categories"):
        load([files / "chair.onnx", files / "chair.ckpt"])


@pytest.mark.parametrize("number", [-1, 19])
def test_a_threshold_that_does_not_exist_is_refused(files: Path, tmp_path: Path, number: int) -> None:
    state = torch.load(files / "chair.ckpt", weights_only=True)
    state["state_dict"]["chosen"].fill_(number)
    torch.save(state, tmp_path / "chair.ckpt")
    with pytest.raises(UserError, match=rf"got the thresholds number \[{number}\], expected 0 to 18"):
        load(tmp_path / "chair.ckpt")


def test_a_checkpoint_that_segments_images_is_refused(files: Path, tmp_path: Path) -> None:
    state = torch.load(files / "chair.ckpt", weights_only=True)
    config = compose("train", ["+experiment=segmentation_hrnet", "scale=test", "paths.run=."])
    OmegaConf.update(config, "choices", ["+experiment=segmentation_hrnet", "scale=test"])
    torch.save(state | {KEY: ConfigInCheckpoint(config).spec}, tmp_path / "hrnet.ckpt")
    with pytest.raises(
        UserError, match=r"hrnet.ckpt, which gives images, expected a checkpoint that gives maps"
    ):
        load(tmp_path / "hrnet.ckpt")


def doubled(content: bytes) -> bytes:
    """A unit that gives each of its maps twice."""
    model = onnx.load_from_string(content)
    model.graph.node.append(onnx.helper.make_node("Concat", ["probabilities"] * 2, ["both"], axis=1))
    del model.graph.output[:]
    model.graph.output.append(onnx.helper.make_tensor_value_info("both", onnx.TensorProto.FLOAT, None))
    return bytes(model.SerializeToString())


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda content: content.replace(b"occupied", b"colour__"), "does not take what a robot sees"),
        (doubled, r"answers float32 of shape \(2, 31, 31\), expected float32 of \(1, 31, 31\)"),
        (lambda content: content.replace(b"occupied", b"\xffccupied"), "cannot be read as ONNX"),
    ],
    ids=["another input", "another answer", "a name that is no text"],
)
def test_a_unit_that_does_not_answer_as_one_is_refused(
    files: Path, tmp_path: Path, change: Callable[[bytes], bytes], told: str
) -> None:
    """Before a robot drives with it."""
    (tmp_path / "strange.onnx").write_bytes(change((files / "chair.onnx").read_bytes()))
    with pytest.raises(UserError, match=told):
        load(tmp_path / "strange.onnx")


def test_a_broken_program_gets_one_message(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """torch logs a traceback of its own."""
    (tmp_path / "noise.pt2").write_bytes(bytes(1000))
    with pytest.raises(UserError, match="cannot be read as a program"):
        load(tmp_path / "noise.pt2")
    assert caplog.records == [] and not logging.getLogger("torch.export").disabled


def test_a_missing_onnxruntime_says_what_to_install(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(UserError, match=r"pip install 'imagination\[onnx\]'"):
        load(files / "chair.onnx")


class Fixed(Toy):
    """Answers the same whatever it sees."""

    def __init__(self, answer: np.ndarray) -> None:
        super().__init__("chair", "bed")
        self.spec = replace(self.spec, thresholds=(0.6, 0.8))
        self.answer = answer

    def __call__(self, observation: Observation) -> np.ndarray:
        return self.answer


def test_a_comparison_by_hand() -> None:
    """Of two views, each category for itself at its own threshold, where an object is that was seen."""
    labels = np.array([[[[1, 0], [1, 1]], [[0, 0], [0, 0]]], [[[0, 0], [0, 0]], [[1, 0], [0, 0]]]], np.bool_)
    seen = np.ones((2, 2), np.bool_)
    given = [
        Sample(sample.observation._replace(seen=seen), label)
        for sample, label in zip(samples(2), labels, strict=True)
    ]
    ours = np.array([[[0.9, 0.6], [0.2, 0.7]], [[0.1, 0.2], [0.3, 0.7]]], np.float32)
    check = compare(Fixed(ours), Fixed(np.full((2, 2, 2), 0.85, np.float32)), given)
    # ours, chair, from 0.6 on: first view 2 of 3 and one false, second view three false; bed, from 0.8: one missed
    assert check.iou == pytest.approx({"chair": 2 / 7, "bed": 0.0})
    assert check.reference_iou == pytest.approx({"chair": 3 / 8, "bed": 1 / 8})
    assert check.loss == pytest.approx(1 / 8) and check.difference == pytest.approx(0.75)
    assert check.told() == "chair 0.2857 (PyTorch 0.3750), bed 0.0000 (PyTorch 0.1250)"
    blind = [Sample(sample.observation._replace(seen=~seen), sample.label) for sample in given]
    assert compare(Fixed(ours), Fixed(ours), blind).iou == {"chair": 0.0, "bed": 0.0}
    assert compare(Fixed(0 * ours), Fixed(ours), given[:1]).iou == {"chair": 0.0}  # no bed is there


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "ckpt: got none"),
        (["ckpt=[]"], "ckpt: got an empty list"),
        (["ckpt=a.ckpt", "views=abc"], "views: got abc, expected a number in [1, 10000] views"),
        (["ckpt=none.ckpt"], "got none.ckpt, but there is no such file"),
        (["ckpt=a.ckpt", "format=tflite"], "format: got 'tflite', expected one of: onnx, torch_export"),
        (["ckpt=a.ckpt", "precision=int4"], "expected one of: float32, int8"),
        (["ckpt=a.ckpt", "look_once=maybe"], "look_once: got 'maybe', expected true or false"),
    ],
)
def test_mistakes_get_one_message(command: Command, arguments: list[str], told: str) -> None:
    done = command("export", *arguments)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert told in done.stderr


def overfit(checkpoint: Checkpoint, path: Path, views: list[Sample], steps: int) -> Checkpoint:
    """Train the unit of a checkpoint, which lies at `path`, until it knows some views."""
    model = checkpoint.model()
    columns = zip(*(inputs(view.observation)[:4] for view in views), strict=True)
    seen = [torch.cat(column) for column in columns]
    labels = torch.from_numpy(np.stack([view.label for view in views])).float()
    optimizer = torch.optim.Adam(model.unit.train().parameters(), 3e-3)
    for _ in range(steps):
        optimizer.zero_grad()
        torch.nn.functional.binary_cross_entropy_with_logits(model.unit(*seen), labels).backward()
        optimizer.step()
    state = torch.load(path, weights_only=True)
    torch.save(state | {"state_dict": model.state_dict()}, path)
    return Checkpoint.read(path)


@pytest.mark.slow
def test_bfloat16_costs_a_trained_unit_half_a_point_at_most(tmp_path: Path) -> None:
    """With the limit as it is configured, on views with many labels that the unit was trained on."""
    path = tmp_path / "chair.ckpt"
    checkpoint = Checkpoint.read(make_checkpoint(path))
    views = sample_views(checkpoint.config, "train", 48)
    views = sorted(views, key=lambda view: -int(view.label.sum()))[:8]
    checkpoint = overfit(checkpoint, path, views, 300)
    export([checkpoint], tmp_path / "chair.pt2", "torch_export", "bfloat16", views)
    check = compare(load(tmp_path / "chair.pt2"), load(path), views)
    assert check.reference_iou["chair"] > 0.2 and check.difference > 1e-3
    assert check.loss <= compose("export", []).max_loss


@pytest.mark.slow
@pytest.mark.parametrize(
    ("format", "how"),
    [
        ("onnx", "precision=float32"),
        ("onnx", "precision=int8"),
        ("onnx", "look_once=true"),
        ("torch_export", "precision=float32"),
        ("torch_export", "precision=bfloat16"),
        ("onnx", "ckpt=[{0}/chair.ckpt,{0}/bed.ckpt]"),
    ],
)
def test_the_command(files: Path, command: Command, format: str, how: str) -> None:
    """On scenes of the run; units that were never trained find little, so the limit on IoU is wide here."""
    how, file = how.format(files), f"chair{'.onnx' if format == 'onnx' else '.pt2'}"
    arguments = [f"ckpt={files / 'chair.ckpt'}", f"format={format}", how, "views=16", "max_loss=0.1"]
    done = command("export", *arguments, f"file={file}", timeout=600)
    assert done.returncode == 0, done.stderr
    assert "on 16 views: largest difference" in done.stderr
    refused = command("export", *arguments, "file=x.txt", timeout=600)
    assert refused.returncode == 2 and "expected a name that ends in" in refused.stderr

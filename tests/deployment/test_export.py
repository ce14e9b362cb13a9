"""Exported units: predictions equal to PyTorch's on rendered views, without torch at run time."""

import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.deployment.export import MAX_IOU_LOSS, Sample, compare, export, sample_views
from imagination.deployment.load import load
from imagination.deployment.torch_backend import inputs
from imagination.export import views_config
from imagination.mapping.predictor import Observation
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.runs.checkpoint import KEY, Checkpoint, hyperparameters
from imagination.utils.errors import UserError
from tests.conftest import ROOT, Command
from tests.helpers.checkpoints import make_checkpoint, samples
from tests.helpers.toy_units import CAMERA, EGO, Toy
from tests.mapping.test_semantic_mapper import frames
from tests.utils.test_cache import make_victim, snapshot


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, unit_file: Path) -> Path:
    """Folder with chair.ckpt, bed.ckpt (another backbone), chair.onnx and both.pt2."""
    folder = tmp_path_factory.mktemp("units")
    shutil.copytree(unit_file.parent, folder, dirs_exist_ok=True)
    chair = Checkpoint.read(folder / "chair.ckpt")
    bed = Checkpoint.read(
        make_checkpoint(folder / "bed.ckpt", "model=projected", "unit_categories=[bed]", threshold=0.65)
    )
    views = samples(2)
    export([chair, bed], folder / "both.pt2", "torch_export", "float32", views)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", ["both.onnx", "both.pt2"])
def test_predictions_equal_those_of_pytorch(files: Path, name: str) -> None:
    if name == "both.onnx":
        checkpoints = [Checkpoint.read(files / f"{category}.ckpt") for category in ("chair", "bed")]
        export(checkpoints, files / name, "onnx", "float32", samples(2))
    module, reference = load(files / name), load([files / "chair.ckpt", files / "bed.ckpt"])
    assert module.spec == reference.spec
    assert module.spec.categories == ("chair", "bed")
    views = samples(6, categories=2)
    check = compare(module, reference, views)
    assert check.difference < 1e-4
    predictions = np.stack([module(view.observation) for view in views])
    assert predictions.min() < 0.4 and predictions.max() > 0.6 and predictions[0].std() > 0.02
    for channel in range(2):  # both units use heights above the floor, which change with the camera's height
        lower = views[0].observation._replace(mount_height=0.9)
        np.testing.assert_allclose(module(lower), reference(lower), atol=1e-4)
        assert np.abs(module(lower) - module(views[0].observation))[channel].max() > 1e-3


@pytest.mark.slow
def test_export_keeps_the_tta_hflip_of_the_checkpoint(tmp_path: Path) -> None:
    """Two checkpoints with the same weights, one of which averages over the view and its mirror image."""
    views, predictors, weights = samples(3), [], {}
    for tta_hflip in ("false", "true"):
        checkpoint = make_checkpoint(
            tmp_path / f"{tta_hflip}.ckpt", "model.postprocess_dilation=0", f"model.tta_hflip={tta_hflip}"
        )
        state = torch.load(checkpoint, weights_only=True)
        weights = weights or state["state_dict"]
        torch.save(state | {"state_dict": weights}, checkpoint)
        file = checkpoint.with_suffix(".onnx")
        export([Checkpoint.read(checkpoint)], file, "onnx", "float32", views)
        predictors.append(load(file))
        assert compare(predictors[-1], load(checkpoint), views).difference < 1e-4
    plain, averaged = predictors
    for view in views:
        observation = view.observation
        flipped = observation._replace(
            **{
                name: np.ascontiguousarray(getattr(observation, name)[:, ::-1])
                for name in ("rgb", "depth", "occupied", "seen")
            }
        )
        logits = [np.log(p / (1 - p)) for p in (plain(observation), plain(flipped)[..., ::-1])]
        mean = 1 / (1 + np.exp(-np.mean(logits, axis=0)))
        np.testing.assert_allclose(averaged(observation), mean, atol=1e-4)
        assert np.abs(averaged(observation) - plain(observation)).max() > 1e-3


def metadata_of(file: Path) -> dict[str, Any]:
    metadata = {entry.key: entry.value for entry in onnx.load(file).metadata_props}
    return json.loads(metadata["imagination"])


def test_metadata_of_the_file(files: Path) -> None:
    metadata = metadata_of(files / "chair.onnx")
    assert metadata["categories"] == ["chair"] and metadata["precision"] == "float32"
    assert metadata["thresholds"] == [0.55]  # selected by its validation
    assert metadata["ego"] == {"resolution": EGO.resolution, "cells": EGO.cells}
    assert metadata["camera"]["width"] == CAMERA.width and metadata["camera"]["mount_height"] == 1.25
    np.testing.assert_allclose(
        metadata["normalisation"][0]["mean"], 255 * np.array([0.485, 0.456, 0.406]), rtol=1e-5
    )


@pytest.mark.slow
def test_it_maps_as_the_checkpoint_does(files: Path) -> None:
    ours, theirs = SemanticMapper(load(files / "chair.onnx")), SemanticMapper(load(files / "chair.ckpt"))
    for frame in frames():
        ours.update(*frame)
        theirs.update(*frame)
    np.testing.assert_allclose(ours.maps.probabilities, theirs.maps.probabilities, atol=1e-3)
    assert ours.maps.thresholds == theirs.maps.thresholds == (0.55,)
    assert SemanticMapper(load(files / "both.pt2")).spec.thresholds == (0.55, 0.65)


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


def test_files_that_are_no_units_are_refused(files: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.onnx"
    broken.write_bytes((files / "chair.onnx").read_bytes()[:5000])
    (tmp_path / "noise.pt2").write_bytes(bytes(1000))
    strange = onnx.load(files / "chair.onnx")
    del strange.metadata_props[:]
    onnx.save(strange, tmp_path / "strange.onnx")
    for path, message in (
        (broken, "cannot be read as ONNX"),
        (tmp_path / "noise.pt2", "cannot be read as a program of torch.export"),
        (tmp_path / "strange.onnx", "was not written by imagination.export"),
        (tmp_path / "none.onnx", "there is no such file"),
        (tmp_path / "unit.pth", r"unit.pth, expected .*\.onnx, \.pt2, \.ckpt"),
    ):
        with pytest.raises(UserError, match=message):
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
    with pytest.raises(UserError, match=rf"got .*\[{number}\], expected 0 to 18"):
        load(tmp_path / "chair.ckpt")


def test_a_checkpoint_that_segments_images_is_refused(files: Path, tmp_path: Path) -> None:
    state = torch.load(files / "chair.ckpt", weights_only=True)
    config = compose("train", ["+experiment=segmentation_hrnet", "scale=test", "paths.run=."])
    OmegaConf.update(config, "choices", ["+experiment=segmentation_hrnet", "scale=test"])
    torch.save(state | {KEY: hyperparameters(config)}, tmp_path / "hrnet.ckpt")
    with pytest.raises(UserError, match=r"unit: got .*hrnet\.ckpt.* images"):
        load(tmp_path / "hrnet.ckpt")


def doubled(content: bytes) -> bytes:
    """A unit that predicts each map twice."""
    model = onnx.load_from_string(content)
    model.graph.node.append(onnx.helper.make_node("Concat", ["probabilities"] * 2, ["both"], axis=1))
    del model.graph.output[:]
    model.graph.output.append(onnx.helper.make_tensor_value_info("both", onnx.TensorProto.FLOAT, None))
    return bytes(model.SerializeToString())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.replace(b"occupied", b"colour__"), "strange.onnx: prediction .* failed"),
        (doubled, r"got .*float32 of shape \(2, 31, 31\)"),
        (lambda content: content.replace(b"occupied", b"\xffccupied"), "cannot be read as ONNX"),
    ],
    ids=["another input", "another prediction", "a name that is no text"],
)
def test_a_unit_with_an_invalid_prediction_is_refused(
    files: Path, tmp_path: Path, change: Callable[[bytes], bytes], message: str
) -> None:
    """At loading time, before a robot uses it."""
    (tmp_path / "strange.onnx").write_bytes(change((files / "chair.onnx").read_bytes()))
    with pytest.raises(UserError, match=message):
        load(tmp_path / "strange.onnx")


def test_a_broken_program_gets_one_message(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """torch logs a traceback of its own."""
    (tmp_path / "noise.pt2").write_bytes(bytes(1000))
    with pytest.raises(UserError, match="cannot be read as a program"):
        load(tmp_path / "noise.pt2")
    assert caplog.records == [] and not logging.getLogger("torch.export").disabled


def test_a_missing_onnxruntime_says_what_to_install(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(UserError, match=r"pip install -e '\.\[onnx\]'"):
        load(files / "chair.onnx")


class Fixed(Toy):
    """Constant prediction."""

    def __init__(self, prediction: np.ndarray) -> None:
        super().__init__("chair", "bed")
        self.spec = replace(self.spec, thresholds=(0.6, 0.8))
        self.prediction = prediction

    def __call__(self, observation: Observation) -> np.ndarray:
        return self.prediction


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
    assert check.summary() == "chair 0.2857 (PyTorch 0.3750), bed 0.0000 (PyTorch 0.1250)"
    blind = [Sample(sample.observation._replace(seen=~seen), sample.label) for sample in given]
    assert compare(Fixed(ours), Fixed(ours), blind).iou == {"chair": 0.0, "bed": 0.0}
    assert compare(Fixed(0 * ours), Fixed(ours), given[:1]).iou == {"chair": 0.0}  # no bed is there


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "ckpt: got none"),
        (["ckpt=[]"], "ckpt: got an empty list"),
        (["ckpt=a.ckpt", "views=abc"], "views: got abc"),
        (["ckpt=none.ckpt"], "got none.ckpt"),
        (["ckpt=a.ckpt", "format=tflite"], "format: got 'tflite'"),
        (["ckpt=a.ckpt", "precision=int4"], "got 'int4'"),
    ],
)
def test_mistakes_get_one_message(command_in_process: Command, arguments: list[str], message: str) -> None:
    done = command_in_process("export", *arguments)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert message in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("choices", [[], ["paths.cache={victim}", "cache.max_gigabytes=0.001"]])
def test_a_checkpoint_chooses_no_cache(tmp_path: Path, choices: list[str]) -> None:
    """Export renders into the cache of the command, and a mapper with the checkpoint needs no folder."""
    victim, path = tmp_path / "victim", tmp_path / "chair.ckpt"
    make_victim(victim)
    state = torch.load(make_checkpoint(path), weights_only=True)
    state[KEY]["choices"] += [choice.format(victim=victim) for choice in choices]
    state[KEY]["values"]["cache"] = {"folder": str(victim), "max_gigabytes": 0.001}
    state[KEY]["values"]["data"]["observer"]["cache"] = {"folder": str(victim), "max_gigabytes": 0.001}
    torch.save(state, path)
    before = snapshot(victim)
    with suppress(UserError) if choices else nullcontext():
        command = compose("export", [f"ckpt={path}", f"paths.outputs={tmp_path}/mine"])
        assert len(sample_views(views_config(command, [Checkpoint.read(path)]), "val", 4)) == 4
        assert list((tmp_path / "mine" / "cache").rglob("*.bin"))
        load(path)
    assert snapshot(victim) == before


def overfit(checkpoint: Checkpoint, path: Path, views: list[Sample], steps: int) -> Checkpoint:
    """Train the unit of the checkpoint at `path` on some views and save it."""
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
    """On views with many labels that the unit was trained on."""
    path = tmp_path / "chair.ckpt"
    checkpoint = Checkpoint.read(make_checkpoint(path))
    views = sample_views(checkpoint.config, "train", 48)
    views = sorted(views, key=lambda view: -int(view.label.sum()))[:8]
    checkpoint = overfit(checkpoint, path, views, 300)
    export([checkpoint], tmp_path / "chair.pt2", "torch_export", "bfloat16", views)
    check = compare(load(tmp_path / "chair.pt2"), load(path), views)
    assert check.reference_iou["chair"] > 0.2 and check.difference > 1e-3
    assert check.loss <= MAX_IOU_LOSS


WITH_A_WIDE_LIMIT = """
from imagination.deployment import export
from imagination.export import main
export.MAX_IOU_LOSS = 0.1
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("format", "how"),
    [
        ("onnx", "precision=float32"),
        ("onnx", "precision=int8"),
        ("torch_export", "precision=float32"),
        ("torch_export", "precision=bfloat16"),
        ("onnx", "ckpt=[{0}/chair.ckpt,{0}/bed.ckpt]"),
    ],
)
def test_the_command(files: Path, command: Command, tmp_path: Path, format: str, how: str) -> None:
    """On scenes of the run; the IoU of untrained units is low and noisy, so the limit on its loss is wide here."""
    how, file = how.format(files), f"chair{'.onnx' if format == 'onnx' else '.pt2'}"
    arguments = [f"ckpt={files / 'chair.ckpt'}", f"format={format}", how, "views=16"]
    done = subprocess.run(
        [sys.executable, "-c", WITH_A_WIDE_LIMIT, *arguments, f"file={file}"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert file in done.stderr and "16 views" in done.stderr
    assert (tmp_path / file).is_file()
    refused = command("export", *arguments, "file=x.txt", timeout=600)
    assert refused.returncode == 2 and "file: got x.txt" in refused.stderr

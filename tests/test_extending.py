"""The examples of docs/extending.md are written into a plugin, checked and used."""

import functools
import inspect
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch.utils.data import DataLoader

from imagination.config.compose import compose
from imagination.config.contracts import check_contracts
from imagination.config.new_plugin import write_plugin
from imagination.config.validation import validate
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.mapping.mapper import Mapper
from imagination.models.lit_unit import LitUnit
from imagination.models.losses import batch_counts
from imagination.scenes.source import SceneSource
from imagination.utils.errors import UserError
from imagination.views.observer import Observer
from imagination.views.pose_samplers import BalancedPoses
from tests.conftest import ROOT, Command
from tests.helpers.batches import random_batch
from tests.helpers.plugin_modules import new_process
from tests.runs.test_resume import points
from tests.scenes import test_source_contract as source_contract
from tests.test_imports import PUBLIC, private_imports

PAGE = (ROOT / "docs" / "extending.md").read_text()
PACKAGE = "imagination_mine"
EXAMPLES = (
    *("Scene source", "Unit", "Encoder", "Backbone", "Loss"),
    *("Update rule", "Callback", "Category", "Sensor"),
)
MAX_LINES = 29
FAST = "ground_truth.spacing=2.0"  # fewer viewpoints of the ground truth


class Section(NamedTuple):
    """Section of the page: text of each file by its path, and words of each command."""

    text: str
    files: dict[str, str]
    commands: list[tuple[str, ...]]

    def command(self, name: str) -> tuple[str, ...]:
        """Return the overrides of the command of this name."""
        (words,) = [words[1:] for words in self.commands if words[0] == name]
        return words


def read(text: str) -> Section:
    block = r"^```(?:python|yaml)\n((?:# @package _global_\n)?# (plugins/\S+)\n.*?)^```"
    files = re.findall(block, text, re.MULTILINE | re.DOTALL)
    commands = re.findall(r"^python -m imagination\.(.*)", text, re.MULTILINE)
    words = [tuple(shlex.split(command, comments=True)) for command in commands]
    return Section(text, {path: content for content, path in files}, words)


SECTIONS = {text.partition("\n")[0]: read(text) for text in re.split(r"^## ", PAGE, flags=re.MULTILINE)}
COMMANDS = [words for section in SECTIONS.values() for words in section.commands]


@pytest.fixture(scope="module")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Write the plugin of the page; yield its folder, in plugins/ of the current directory."""
    folder = tmp_path_factory.mktemp("extending")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_plugin("mine")  # the first command of the page
    for section in SECTIONS.values():
        for path, text in section.files.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text)
    root = folder / "plugins" / "mine"
    assert (root / PACKAGE / "__init__.py").is_file()
    with pytest.MonkeyPatch.context() as patch, new_process(root):
        patch.chdir(folder)
        yield root
    composed.cache_clear()


@functools.cache
def composed(*words: str) -> DictConfig:
    """Compose a command of the page at the scale of the tests."""
    name, *overrides = words
    return compose(name, [*overrides, *(() if name == "plugins" else ("scale=test", "paths.run=."))])


def training(title: str) -> DictConfig:
    """Compose the training command of a section."""
    return composed("train", *SECTIONS[title].command("train"))


def training_words(*titles: str) -> list[str]:
    """Return the overrides of the training commands of several sections, each once."""
    return list(dict.fromkeys(word for title in titles for word in SECTIONS[title].command("train")))


def test_every_block_of_code_is_a_file_and_every_section_an_example() -> None:
    assert set(EXAMPLES) <= set(SECTIONS)
    blocks = len(re.findall(r"^```(?:python|yaml)$", PAGE, re.MULTILINE))
    assert blocks == sum(len(section.files) for section in SECTIONS.values()) > len(EXAMPLES)


@pytest.mark.parametrize("title", EXAMPLES)
def test_an_example_is_short(title: str) -> None:
    files = SECTIONS[title].files
    assert files and all(path.startswith("plugins/mine/") for path in files)
    lines = [line for text in files.values() for line in text.splitlines() if line.strip()]
    assert len(lines) <= MAX_LINES


def test_examples_import_only_what_is_public_and_the_page_names_it() -> None:
    for section in SECTIONS.values():
        for path, text in section.files.items():
            assert path.endswith(".yaml") or not private_imports(text), path
    paragraph = PAGE.partition("**What a plugin may import.**")[2].partition("\n\n")[0]
    assert {name.rpartition(".")[2] for name in PUBLIC} <= set(re.findall(r"`(\w+)`", paragraph))


def test_the_plugin_passes_the_check(
    plugin: Path, command_in_process: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "mine").symlink_to(plugin, target_is_directory=True)
    monkeypatch.setattr(sys, "path", sys.path[:])  # the command extends it
    done = command_in_process("plugins", "check=true")
    status = done.stdout.partition("mine  (folder ")[2].splitlines()[1]
    options = {
        path.partition("/conf/")[2].removesuffix(".yaml")
        for section in SECTIONS.values()
        for path in section.files
        if path.endswith(".yaml")
    }
    template = {"experiment/mine_chair", "mapping/registration/mine_average", "model/loss/mine_bce"}
    assert status.strip() == f"adds {', '.join(sorted(options | template))}"


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_composes(plugin: Path, words: tuple[str, ...]) -> None:
    config = composed(*words)
    if words[0] == "plugins":
        assert config.new == "mine"
        return
    validate(config)
    if words[0] == "train":
        check_contracts(config)


def contract_tests() -> list[str]:
    """Names of the tests of the contract that need only a source."""
    given = {"source", "scene", "images", "tmp_path"}
    tests = {name: test for name, test in vars(source_contract).items() if name.startswith("test_")}
    arguments = {name: set(inspect.signature(test).parameters) for name, test in tests.items()}
    return [name for name, names in arguments.items() if names <= given and names - {"tmp_path"}]


@pytest.fixture(scope="module")
def source(plugin: Path) -> dict[str, Any]:
    """The scene source of the page, its first scene, and images of it."""
    source: SceneSource = instantiate(training("Scene source").data.scenes)
    scene = source.load(source.scenes("train")[0])
    return {"source": source, "scene": scene, "images": source_contract.rendered(scene)}


@pytest.mark.parametrize("name", contract_tests())
def test_the_scene_source_fulfils_the_contract_of_all_sources(
    source: dict[str, Any], name: str, tmp_path: Path
) -> None:
    test = getattr(source_contract, name)
    given = {**source, "tmp_path": tmp_path}
    test(**{argument: given[argument] for argument in inspect.signature(test).parameters})


def test_the_scene_source_refuses_other_scenes(source: dict[str, Any]) -> None:
    assert len(contract_tests()) >= 8
    with pytest.raises(
        UserError, match="scene: got 'train_2', expected one of: test_0, train_0, train_1, val_0"
    ):
        source["source"].load("train_2")


@pytest.mark.parametrize("title", ["Unit", "Encoder", "Backbone", "Loss"])
def test_a_part_of_the_network_is_trained(plugin: Path, title: str) -> None:
    torch.manual_seed(0)
    task: LitUnit = instantiate(training(title).model.module)
    assert any(type(part).__module__.startswith(PACKAGE) for part in [*task.modules(), task.loss])
    batch = random_batch(size=48, cells=31)
    optimizer = task.configure_optimizers()["optimizer"]
    losses = []
    for _ in range(8):
        optimizer.zero_grad()
        loss, _ = task.training_loss(batch)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    assert all(weight.grad is not None for weight in task.parameters() if weight.requires_grad)
    maps = task.predict(batch).maps
    assert maps.shape == batch["label"].shape and 0 <= maps.min() < maps.max() <= 1


@pytest.mark.parametrize("gamma", [0.0, 1.5])
def test_the_loss_is_the_focal_loss_of_the_whole_batch(plugin: Path, gamma: float) -> None:
    loss = instantiate(training("Loss").model.loss, gamma=gamma)
    batch = random_batch(views=6, categories=2)
    label, neighbourhood = batch["label"], batch["neighbourhood"]
    logits = torch.randn(label.shape, generator=torch.Generator().manual_seed(1))
    correct = torch.where(label > 0, logits, -logits).double().sigmoid()  # probability of the label
    expected = -((1 - correct) ** gamma * correct.log()).sum() / 6
    result, _ = loss(logits, label, neighbourhood)
    torch.testing.assert_close(result.double(), expected, rtol=1e-5, atol=0)
    counts = batch_counts(label, neighbourhood)
    parts = [
        loss(logits[rows], label[rows], neighbourhood[rows], counts).loss
        for rows in (slice(0, 1), slice(1, 6))
    ]
    torch.testing.assert_close(sum(parts), result)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.8], 0.8),
        ([0.8, 0.8], 16 / 17),  # odds of 4 to 1, twice
        ([0.8, 0.2], 0.5),
        ([1.0] * 9, 1 / (1 + np.exp(-5))),
        ([0.0] * 9, 1 / (1 + np.exp(5))),
    ],
)
def test_the_update_rule_adds_log_odds(plugin: Path, values: list[float], expected: float) -> None:
    rule = instantiate(
        composed("evaluate", *SECTIONS["Update rule"].command("evaluate")).mapping.registration
    )
    mapper = Mapper(Grid.centred(9.0, 1.0), EgoGrid(resolution=1.0, cells=3), ["chair"], rule)
    for value in values:
        mapper.register(
            np.full((1, 3, 3), value, np.float32), np.ones((1, 3, 3), bool), Pose(0.0, 0.0, np.pi / 2)
        )
    written = mapper.probabilities[mapper.written]
    np.testing.assert_allclose(written, expected, rtol=1e-5)
    with pytest.raises(UserError, match="mapping.registration.limit: got 0"):
        type(rule)(limit=0.0)


def test_the_callback_logs_the_norm_of_the_gradients(plugin: Path) -> None:
    config = training("Callback")
    torch.manual_seed(0)
    task: LitUnit = instantiate(config.model.module)
    trainer = lightning.Trainer(
        max_epochs=1,
        accelerator="cpu",
        callbacks=[instantiate(config.callbacks.gradient_norm)],
        **dict.fromkeys(
            ("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False
        ),
    )
    trainer.fit(task, DataLoader([random_batch(size=48, cells=31)], batch_size=None))
    gradients = [weight.grad for weight in task.parameters() if weight.grad is not None]
    expected = torch.cat([gradient.flatten() for gradient in gradients]).norm()
    torch.testing.assert_close(trainer.callback_metrics["train/gradient_norm"], expected, rtol=1e-4, atol=0)


def test_the_category_is_in_the_views(plugin: Path) -> None:
    config = composed("train", *SECTIONS["Category"].command("train"), "data.splits.train=9", FAST)
    by_command_line = composed("render", *SECTIONS["Category"].command("render")).categories.sofa
    assert by_command_line.aliases.procedural == config.categories.sofa.aliases.procedural
    observer: Observer = instantiate(config.data.observer)
    assert observer.categories.names == ["chair", "bed", "table", "sofa"]
    scenes = (observer.scene(name) for name in observer.source.scenes("train"))
    scene = next(scene for scene in scenes if scene.of_category("sofa"))
    rng = np.random.default_rng(0)
    poses = BalancedPoses(["sofa"], fraction=1.0, spread=0.1)(scene, 12, rng)
    views = [observer.observe(scene.name, pose, rng) for pose in poses]
    assert any((view.categories == 4).any() for view in views)
    assert any(view.object[3].any() for view in views)


def test_the_sensor_and_the_camera_change_the_views(plugin: Path) -> None:
    words = [*training_words("Sensor", "Scene source"), FAST]
    noisy: Observer = instantiate(composed("train", *words).data.observer)
    ideal: Observer = instantiate(composed("train", *words, "sensor=ideal").data.observer)
    camera = noisy.camera
    assert (camera.width, camera.height, camera.mount_height) == (160, 120, 0.4)
    assert np.rad2deg([camera.field_of_view, camera.pitch]) == pytest.approx([60, -10])
    name = noisy.source.scenes("train")[-1]
    poses = [Pose(-1.7, side, -np.sign(side) * np.pi / 4) for side in (-1.7, 1.7)]  # along the diagonals

    def depths(observer: Observer) -> np.ndarray:
        rng = np.random.default_rng(1)
        return np.stack([observer.observe(name, pose, rng).depth for pose in poses])

    exact, measured = depths(ideal), depths(noisy)
    assert exact.shape == (2, 120, 160) and (exact > 4).any()
    assert (measured[exact > 4] == 0).all()
    near = (exact > 0) & (exact <= 4)
    errors = (measured - exact)[near] / exact[near] ** 2
    assert errors.std() == pytest.approx(0.002, rel=0.05) and abs(errors.mean()) < 1e-4
    np.testing.assert_array_equal(depths(noisy), measured)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["unit", "tiny"])
def test_a_training_with_the_plugin(plugin: Path, command: Command, tmp_path: Path, model: str) -> None:
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "mine").symlink_to(plugin, target_is_directory=True)
    words = training_words("Scene source", "Encoder", "Backbone", "Loss", "Callback", "Sensor")
    done = command("train", *words, "mapping/registration=log_odds", f"model={model}", "scale=test")
    assert done.returncode == 0, done.stderr
    run = tmp_path / "outputs" / "chair_unet" / "latest"
    assert {"train/loss", "train/gradient_norm"} <= set(points(run / "tensorboard"))
    assert "chair" in (run / "tables" / "mapping.csv").read_text()
    done = command("evaluate", *SECTIONS["Update rule"].command("evaluate"))
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_training_for_the_category(plugin: Path, command: Command, tmp_path: Path) -> None:
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "mine").symlink_to(plugin, target_is_directory=True)
    more = "data.splits={train: 4, val: 3, test: 3}"
    done = command("train", *SECTIONS["Category"].command("train"), "scale=test", more)
    assert done.returncode == 0, done.stderr
    assert "sofa" in (tmp_path / "outputs" / "sofa_unet" / "latest" / "tables" / "mapping.csv").read_text()

"""Classes of plugins that lack something of their contract are refused, by `plugins check=true` and before training."""

import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.config.contracts import CONTRACTS, check_contracts, plugin_problem
from imagination.utils.errors import UserError

GOOD = """
class Rule:
    def __call__(self, old, new, count):
        return new

class Encoder:
    def __init__(self):
        self.channels = 3
    def forward(self, rgb):
        return rgb

class Backbone:
    def __init__(self):
        self.width = 4
    def forward(self, maps, image=None):
        return maps

class Sensor:
    def __call__(self, image, rng):
        return image

class Loss:
    in_parts = False
    def __call__(self, logits, label, neighbourhood, counts=None):
        return logits

class Unit:
    def __init__(self):
        self.categories = ["chair"]
    def forward(self, rgb, depth, occupied, seen):
        return depth
"""

PLACES = {
    "mapping/registration": ("Rule", "def __call__(self, old, new, count)", "def __call__(self, old, new)"),
    "model/encoder": ("Encoder", "self.channels = 3", "self.width = 3"),
    "model/backbone": ("Backbone", "self.width = 4", "self.size = 4"),
    "model/loss": ("Loss", "in_parts = False", "parts = False"),
    "model": ("Unit", "self.categories = ", "self.names = "),
    "sensor": ("Sensor", "def __call__(self, image, rng)", "def __call__(self, image)"),
}
MISSING = {
    "mapping/registration": "__call__(old, new, count)",
    "model/encoder": "channels",
    "model/backbone": "width",
    "model/loss": "in_parts",
    "model": "categories",
    "sensor": "__call__(image, rng)",
}


def plugin(folder: Path, group: str, code: str, name: str) -> Path:
    """Write a plugin with one class; return its conf tree."""
    (folder / name).mkdir(parents=True)
    (folder / name / "__init__.py").write_text(code)
    conf = folder / "conf" / group
    conf.mkdir(parents=True)
    target = f"_target_: {name}.{PLACES[group][0]}"
    (conf / "mine.yaml").write_text(f"unit:\n  {target}\n" if group == "model" else f"{target}\n")
    return folder / "conf"


@pytest.mark.parametrize("group", PLACES)
@pytest.mark.parametrize("broken", [False, True])
def test_contract(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: str, broken: bool) -> None:
    name = f"contract_{group.replace('/', '_')}_{broken}"
    _, good, bad = PLACES[group]
    conf = plugin(tmp_path, group, GOOD.replace(good, bad) if broken else GOOD, name)
    monkeypatch.syspath_prepend(tmp_path)
    place = "model.unit" if group == "model" else group.replace("/", ".")
    config = OmegaConf.create()
    OmegaConf.update(config, place, {"_target_": f"{name}.{PLACES[group][0]}"})
    if not broken:
        assert plugin_problem(conf) == ""
        check_contracts(config)
        return
    contract = CONTRACTS[place].name
    assert MISSING[group] in plugin_problem(conf) and contract in plugin_problem(conf)
    with pytest.raises(UserError) as error:
        check_contracts(config)
    message = str(error.value)
    assert message.startswith(f"{place}: got ") and MISSING[group] in message and contract in message
    assert name in sys.modules


def test_the_example_plugin_and_experiments_fulfil_their_contracts(
    example_plugin: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(example_plugin)
    assert plugin_problem(example_plugin / "conf") == ""
    for experiment in ("chair_unet", "all_units", "segmentation_hrnet"):
        check_contracts(compose("train", [f"experiment={experiment}", "scale=test", "paths.run=."]))


@pytest.mark.parametrize("assigned", ["width", "size"])
def test_a_backbone_is_checked_without_its_arguments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, assigned: str
) -> None:
    code = f"""
class Backbone:
    def __init__(self, in_channels, image_channels, width):
        self.{assigned} = width
    def forward(self, maps, image=None):
        return maps
"""
    name = f"backbone_with_{assigned}"
    plugin(tmp_path, "model/backbone", code, name)
    monkeypatch.syspath_prepend(tmp_path)
    node = {"_target_": f"{name}.Backbone", "_partial_": True, "width": 4}
    config = OmegaConf.create({"model": {"backbone": node}})
    if assigned == "width":
        check_contracts(config)
    else:
        with pytest.raises(
            UserError, match=rf"model.backbone: got {name}.Backbone, .*width.*backbones.Backbone"
        ):
            check_contracts(config)


def test_a_class_of_a_library_is_checked() -> None:
    config = OmegaConf.create({"model": {"loss": {"_target_": "torch.nn.BCELoss"}}})
    with pytest.raises(UserError, match=r"model.loss: got torch.nn.BCELoss, .*neighbourhood.*losses.Loss"):
        check_contracts(config)

"""The table of keys covers the configuration, and its roles are those that users rely on."""

import pytest
from omegaconf import OmegaConf

from imagination.config.compose import compose
from imagination.config.key_roles import KEYS, Role, is_resumable, role
from imagination.config.overrides import set_keys

ELSEWHERE = (
    "data.shards",
    "data.module.shard",
    "viewer.",
    "ckpt",
    "ade20k",
    "experiments",
    "seeds",
    "compare",
    "study",
)
"""Prefixes of keys that other commands or options have."""


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("seed", Role.TRAINING),
        ("experiment", Role.TRAINING),
        ("model/encoder", Role.TRAINING),
        ("model/loss@model.loss", Role.TRAINING),
        ("data.scenes.folder", Role.TRAINING),
        ("trainer.max_epochs", Role.TRAINING),
        ("callbacks.replay_buffer.size", Role.TRAINING),
        ("key_of_a_plugin", Role.TRAINING),
        ("mapping/registration", Role.EVALUATION),
        ("evaluation.approaches.mine", Role.EVALUATION),
        ("paths.cache", Role.LOCATION),
        ("cache.folder", Role.LOCATION),
        ("data.observer.cache.folder", Role.LOCATION),
        ("data.scenes.cache", Role.LOCATION),
        ("data.module.observer.cache.folder", Role.LOCATION),
        ("data.workers", Role.EXECUTION),
        ("trainer.devices", Role.EXECUTION),
        ("callbacks", Role.TRAINING),
        ("callbacks.progress_bar", Role.EXECUTION),
        ("trainer", Role.EXECUTION),
        ("trainer.gradient_clip_val", Role.TRAINING),
        ("model/loss@cache", Role.LOCATION),
        ("data@paths", Role.LOCATION),
        ("hydra/launcher", Role.EXECUTION),
        ("logger.csv.save_dir", Role.EXECUTION),
        ("sweep", Role.COMMAND),
    ],
)
def test_role(key: str, expected: Role) -> None:
    assert role(key) == expected


def test_a_resumed_run_may_be_longer_and_elsewhere_but_not_another_one() -> None:
    assert all(map(is_resumable, ("trainer.max_epochs", "trainer.devices", "data.workers", "paths.outputs")))
    assert not any(map(is_resumable, ("seed", "model.width", "trainer.precision", "evaluation.cell_widths")))


def test_every_key_of_the_table_exists() -> None:
    experiments = ("experiment=chair_unet", "experiment=segmentation_hrnet")
    configs = [compose("train", [experiment, "paths.run=."]) for experiment in experiments]
    trainer_arguments = {key for key in KEYS if key.startswith("trainer.")}  # checked by Lightning
    for key in KEYS.keys() - trainer_arguments - {"sweep", "hparams_search", "local"}:
        if key.startswith((*ELSEWHERE, "hydra")):
            continue
        parent, _, name = key.removesuffix(".*").rpartition(".")
        nodes = [OmegaConf.select(config, parent) if parent else config for config in configs]
        assert any(node is not None and name in node for node in nodes), key


def test_a_dictionary_sets_the_keys_within_it() -> None:
    assert set_keys("data={observer: {cache: {folder: /x}}, workers: 1}") == [
        "data.observer.cache.folder",
        "data.workers",
    ]

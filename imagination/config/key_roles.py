"""Table of the configuration keys: role, range, unit, symbol in the paper, and earlier names.

The role of a key decides whether a checkpoint stores it and may set it, whether a resumed run may change it, and
whether two jobs of a sweep that differ in it share one training. `docs/reference/configuration.md` shows the table.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple


class Role(StrEnum):
    """Effect of a configuration key."""

    TRAINING = "training"
    """Changes the result of a training, and of its evaluation."""

    EVALUATION = "evaluation"
    """Changes only the evaluation of a trained network."""

    LOCATION = "location"
    """Path of inputs, outputs or caches; the same results are found elsewhere."""

    EXECUTION = "execution"
    """Hardware, processes, logging and screen output; results do not depend on it."""

    COMMAND = "command"
    """Selects the jobs of a command, or the runs that it reads."""


RESULT_ROLES = (Role.TRAINING, Role.EVALUATION)
"""Roles of the keys that determine results: checkpoints store them, and only they may be set by a checkpoint."""


class Key(NamedTuple):
    """Row of the table.

    Attributes:
        role: effect of the key.
        low, high: bounds of a number, or of each number in a list; integer bounds require whole numbers. None if the
            value is not a number.
        unit: unit of the number.
        symbol: symbol or name in the paper.
        old: earlier names, which are refused with the current one.
        resumable: whether a resumed run may change the value.
    """

    role: Role
    low: float | None = None
    high: float | None = None
    unit: str = ""
    symbol: str = ""
    old: tuple[str, ...] = ()
    resumable: bool = False


def _training(
    low: float,
    high: float,
    unit: str = "",
    symbol: str = "",
    old: tuple[str, ...] = (),
    resumable: bool = False,
) -> Key:
    return Key(Role.TRAINING, low, high, unit, symbol, old, resumable)


LARGE = 10**9
"""Upper bound of numbers of epochs."""

KEYS: Mapping[str, Key] = {
    # experiment
    "name": Key(Role.TRAINING),
    "seed": _training(0, 2**32 - 1),
    "unit_categories": Key(Role.TRAINING),
    "aggregation_factor": _training(0.0, 1.0, symbol="aggregation factor"),
    # geometry
    "camera.width": _training(8, 8192, "pixels", old=("scale.image",)),
    "camera.height": _training(8, 8192, "pixels"),
    "ego.extent": _training(0.5, 100.0, "m", "V", ("scale.ego_extent",)),
    "ego.resolution": _training(0.005, 1.0, "m", old=("scale.resolution",)),
    "world.extent": _training(1.0, 10_000.0, "m", "M", ("scale.world_extent",)),
    "world.resolution": _training(0.005, 1.0, "m"),
    "robot.radius": _training(0.0, 2.0, "m"),
    "kernels.imaginable": _training(0.005, 10.0, "m", "δ"),
    "kernels.neighbourhood": _training(0.005, 10.0, "m", "ε"),
    "kernels.ground_truth": _training(0.005, 10.0, "m", "dilation kernel", ("kernels.truth",)),
    "ground_truth.camera.width": _training(8, 8192, "pixels", old=("scale.gt_image", "scale.truth_image")),
    # data
    "data.splits.train": _training(1, 9999, "scenes", old=("scale.scenes.train", "scale.homes.train")),
    "data.splits.val": _training(1, 9999, "scenes", old=("scale.scenes.val", "scale.homes.val")),
    "data.splits.test": _training(1, 9999, "scenes", old=("scale.scenes.test", "scale.homes.test")),
    "data.splits": Key(Role.TRAINING, old=("scale.scenes", "scale.homes")),
    "data.eval_views.val": _training(1, 10_000_000, "views", old=("scale.eval_views.val",)),
    "data.eval_views.test": _training(1, 10_000_000, "views", old=("scale.eval_views.test",)),
    "data.eval_views": Key(Role.TRAINING, old=("scale.eval_views", "scale.held_out_views")),
    "data.parallel_scenes": _training(1, 4096, "scenes", old=("scale.parallel_scenes",)),
    "data.balanced_fraction": _training(
        0.0, 1.0, old=("scale.balanced_fraction", "scale.balanced_share", "data.sampler.share")
    ),
    "data.hflip_probability": _training(
        0.0,
        1.0,
        old=(
            *("scale.hflip_probability", "scale.mirrored_share"),
            *("callbacks.replay_buffer.hflip_probability", "callbacks.replay_buffer.mirrored_share"),
        ),
    ),
    "data.batch_size": _training(1, 100_000, "views", "B", ("scale.batch_size",)),
    "data.micro_batches": _training(1, 100_000, "micro-batches", old=("scale.accumulate",)),
    "data.workers": Key(Role.EXECUTION, 0, 1024, "processes", old=("scale.workers",), resumable=True),
    # the folder of shards may have been moved; reading it checks its kind
    "data.shards": Key(Role.TRAINING, resumable=True),
    "data.module.shard_cache": Key(Role.LOCATION),
    "data.module.shard_gigabytes": Key(Role.EXECUTION),
    "data.module.observer": Key(Role.LOCATION),  # set data.observer instead
    "data.module.eval_sampler": Key(Role.TRAINING, old=("data.module.held_out_sampler",)),
    "data.observer.ground_truth_spec": Key(Role.TRAINING, old=("data.observer.truth_spec",)),
    "callbacks.replay_buffer.size": _training(1, 10_000_000, "views", "N", ("scale.buffer_size",)),
    "callbacks.replay_buffer.update_interval": _training(
        1, 10_000, "collection steps", "update interval", ("scale.update_interval",)
    ),
    "callbacks.replay_buffer.update_batches": _training(
        1, 100_000, "batches", "update batches", ("scale.update_batches",)
    ),
    "callbacks.replay_buffer.prefill_steps": _training(
        0, 10_000_000, "collection steps", old=("scale.prefill_steps",)
    ),
    "callbacks.replay_buffer.collection_epochs": _training(
        1, LARGE, "epochs", old=("callbacks.replay_buffer.collecting_rounds",)
    ),
    "callbacks.early_stopping.min_delta": _training(
        0.0, 1.0, old=("callbacks.early_stopping.margin", "callbacks.until_flat.margin")
    ),
    "callbacks.early_stopping": Key(Role.TRAINING, old=("callbacks.until_flat",)),
    # model
    "model.optimizer.lr": _training(0.0, 10.0, old=("scale.learning_rate",)),
    "model.final_learning_rate": _training(0.0, 10.0, old=("scale.final_learning_rate",)),
    "model.schedule_epochs": _training(1, LARGE, "epochs"),
    "model.width": _training(1, 1024, "channels", old=("scale.unit_width",)),
    "model.encoder_shrink": _training(1, 64, old=("scale.encoder_shrink",)),
    "model.heights": Key(Role.TRAINING, unit="m", old=("scale.heights",)),
    "model.height_jitter": _training(0.0, 0.5, old=("scale.height_jitter",)),
    "model.tta_hflip": Key(Role.TRAINING, old=("scale.tta_hflip", "scale.mirrored_answers")),
    "model.postprocess_dilation": _training(
        0.0, 2.0, "m", old=("scale.postprocess_dilation", "scale.dilated_answers")
    ),
    "model.loss.alpha_max": Key(Role.TRAINING, symbol="w_α"),
    "model.loss.gamma_max": Key(Role.TRAINING, symbol="w_γ"),
    "model.module.valid_threshold": Key(Role.TRAINING, symbol="τ_valid"),
    "model.module.compile": Key(Role.EXECUTION),
    "hrnet.network": Key(Role.TRAINING, old=("scale.hrnet",)),
    "hrnet.micro_batches": _training(1, 100_000, "micro-batches", old=("scale.hrnet_accumulate",)),
    "hrnet.collection_epochs": _training(1, LARGE, "epochs"),
    "hrnet.epochs": _training(1, LARGE, "epochs", old=("scale.hrnet_epochs", "scale.hrnet_rounds")),
    "hrnet.max_epochs": _training(
        1, LARGE, "epochs", old=("scale.hrnet_max_epochs", "scale.hrnet_most_rounds")
    ),
    "hrnet.final_learning_rate": _training(0.0, 10.0, old=("scale.hrnet_final_learning_rate",)),
    "hrnet.check_val_every_n_epoch": _training(1, 1_000_000, "epochs", old=("scale.hrnet_eval_every",)),
    # trainer
    "trainer.max_epochs": _training(1, LARGE, "epochs", old=("scale.epochs", "scale.rounds"), resumable=True),
    "trainer.min_epochs": Key(
        Role.TRAINING,
        unit="epochs",
        old=(
            *("callbacks.early_stopping.min_epochs", "callbacks.early_stopping.min_rounds"),
            "callbacks.until_flat.min_rounds",
        ),
    ),
    "trainer.accumulate_grad_batches": _training(1, 100_000, "batches"),
    "trainer.check_val_every_n_epoch": _training(1, 1_000_000, "epochs", old=("scale.eval_every",)),
    "trainer.precision": Key(Role.TRAINING, old=("scale.precision",)),
    "trainer.accelerator": Key(Role.EXECUTION, resumable=True),
    "trainer.devices": Key(Role.EXECUTION, 1, 1024, "devices", resumable=True),
    "trainer.num_nodes": Key(Role.EXECUTION, 1, 10_000, "hosts", resumable=True),
    "trainer.strategy": Key(Role.EXECUTION),
    "trainer.default_root_dir": Key(Role.LOCATION),
    "trainer.profiler": Key(Role.EXECUTION),
    "trainer.enable_progress_bar": Key(Role.EXECUTION),
    "trainer.enable_model_summary": Key(Role.EXECUTION),
    "trainer.log_every_n_steps": Key(Role.EXECUTION),
    "trainer.logger": Key(Role.EXECUTION),
    "trainer.callbacks": Key(Role.EXECUTION),
    "trainer.plugins": Key(Role.EXECUTION),
    "trainer.*": Key(Role.TRAINING),
    "trainer": Key(Role.EXECUTION),  # the group selects hardware
    # evaluation
    "evaluation.cell_widths": Key(Role.EVALUATION, 0.25, 50.0, "m", "cell width", ("scale.cell_widths",)),
    "evaluation.viewpoint_sets": Key(Role.EVALUATION, 1, 10_000, old=("scale.viewpoint_sets",)),
    "evaluation.orientations": Key(
        Role.EVALUATION, 1, 1000, symbol="orientations", old=("scale.orientations",)
    ),
    "evaluation.known_scenes": Key(Role.EVALUATION, old=("evaluation.known_homes",)),
    "evaluation": Key(Role.EVALUATION),
    "study": Key(Role.EVALUATION),
    "ade20k": Key(Role.EVALUATION),
    "mapping.valid_threshold": Key(Role.EVALUATION, symbol="τ_valid"),
    "mapping.valid_kernel": Key(Role.EVALUATION, 0.005, 10.0, "m", "ε"),
    "mapping": Key(Role.EVALUATION),
    "callbacks.mapping_evaluation.scenes": Key(
        Role.EVALUATION,
        1,
        100_000,
        "scenes",
        old=("scale.eval_scenes", "scale.eval_homes", "callbacks.mapping_evaluation.homes"),
    ),
    "callbacks.mapping_evaluation.every_n_epochs": Key(
        Role.EVALUATION, old=("callbacks.mapping_evaluation.every_n_rounds",)
    ),
    "callbacks.mapping_evaluation.protocol": Key(Role.LOCATION),  # set evaluation instead
    "callbacks.mapping_evaluation.folder": Key(Role.LOCATION),
    "callbacks.mapping_evaluation": Key(Role.EVALUATION),
    # where
    "paths": Key(Role.LOCATION, resumable=True),
    "cache.max_gigabytes": Key(Role.LOCATION, 0.001, 1_000_000.0, "GB", resumable=True),
    "cache": Key(Role.LOCATION, resumable=True),
    "local": Key(Role.LOCATION),
    # how
    "callbacks.unit_images": Key(Role.EXECUTION, old=("callbacks.pictures",)),
    "callbacks.segmentation_images": Key(Role.EXECUTION, old=("callbacks.segmentation_pictures",)),
    "callbacks.training_stats": Key(Role.EXECUTION, old=("callbacks.record",)),
    "callbacks.seed_per_epoch": Key(Role.EXECUTION, old=("callbacks.seeding",)),
    "callbacks.learning_rate_monitor": Key(Role.EXECUTION),
    "callbacks.progress_bar": Key(Role.EXECUTION, old=("callbacks.progress",)),
    "callbacks.last_checkpoint": Key(Role.EXECUTION),
    "callbacks.best_checkpoint.dirpath": Key(Role.LOCATION),
    "callbacks": Key(Role.TRAINING),
    "viewer.max_frames": Key(Role.EXECUTION, old=("viewer.most",)),
    "logger": Key(Role.EXECUTION),
    "extras": Key(Role.EXECUTION),
    "train": Key(Role.EXECUTION, resumable=True),
    "test": Key(Role.EXECUTION, resumable=True),
    "optimized_metric": Key(Role.EXECUTION),
    "hydra.sweep.dir": Key(Role.LOCATION, old=("sweep_dir",)),
    "hydra.run.dir": Key(Role.LOCATION),
    "hydra": Key(Role.EXECUTION),
    "program": Key(Role.EXECUTION),
    # which
    "choices": Key(Role.COMMAND),
    "ckpt": Key(Role.COMMAND),
    "ckpt_path": Key(Role.COMMAND, resumable=True),
    "resume": Key(Role.COMMAND, resumable=True),
    "sweep": Key(Role.COMMAND),
    "hparams_search": Key(Role.COMMAND),
    "experiments": Key(Role.COMMAND),
    "seeds": Key(Role.COMMAND),
    "compare": Key(Role.COMMAND),
}
"""Keys and nodes with their rows; `node.*` stands for the keys of a node but not for the group of that name.

A key that is not listed has the role of the longest listed node that contains it. Without such a node it changes the
training, as the keys of plugins do."""

OPTIONAL_GROUPS = ("experiment", "sweep", "hparams_search", "study", "debug")
"""Groups without a default option. `+experiment=chair_unet` is read as `experiment=chair_unet`."""


def role(key: str) -> Role:
    """Return the role of a dotted key or of a group.

    >>> role("model.loss.alpha_max"), role("mapping/registration"), role("trainer.devices")
    (<Role.TRAINING: 'training'>, <Role.EVALUATION: 'evaluation'>, <Role.EXECUTION: 'execution'>)
    """
    row = _row(key)
    return row.role if row else Role.TRAINING


def is_resumable(key: str) -> bool:
    """Return whether a resumed run may change a key."""
    row = _row(key)
    return row is not None and row.resumable


def _row(key: str) -> Key | None:
    """Return the row of a key, or of the longest node in the table that contains it.

    A node with the name of a node of locations, such as the cache of a scene source, is one wherever it is.
    """
    group, _, package = key.partition("@")
    if package and not package.startswith("_") and role(package) not in RESULT_ROLES:
        return _row(package)  # the option is placed in this node
    parts = group.replace("/", ".").split(".")
    for name in ("paths", "cache"):
        if name in parts:
            return KEYS[".".join(parts)] if ".".join(parts) in KEYS else KEYS[name]
    for count in range(len(parts), 0, -1):
        prefix = ".".join(parts[:count])
        if row := KEYS.get(f"{prefix}.*" if count < len(parts) else prefix, KEYS.get(prefix)):
            return row
    return None

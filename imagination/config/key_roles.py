"""Ranges and units of configuration keys."""

from collections.abc import Mapping

RANGES: Mapping[str, tuple[float, float, str]] = {
    "seed": (0, 2**32 - 1, ""),
    "aggregation_factor": (0.0, 1.0, ""),
    "kernels.imaginable": (0.005, 10.0, "m"),
    "kernels.neighbourhood": (0.005, 10.0, "m"),
    "kernels.ground_truth": (0.005, 10.0, "m"),
    "robot.radius": (0.0, 2.0, "m"),
    "cache.max_gigabytes": (0.001, 1_000_000.0, "GB"),
    "scale.resolution": (0.005, 1.0, "m"),
    "scale.ego_extent": (0.5, 100.0, "m"),
    "scale.world_extent": (1.0, 10_000.0, "m"),
    "scale.image": (8, 8192, "pixels"),
    "scale.gt_image": (8, 8192, "pixels"),
    "scale.scenes.train": (1, 9999, "scenes"),
    "scale.scenes.val": (1, 9999, "scenes"),
    "scale.scenes.test": (1, 9999, "scenes"),
    "scale.eval_views.val": (1, 10_000_000, "views"),
    "scale.eval_views.test": (1, 10_000_000, "views"),
    "scale.parallel_scenes": (1, 4096, "scenes"),
    "scale.balanced_fraction": (0.0, 1.0, ""),
    "scale.update_interval": (1, 10_000, "collection steps"),
    "scale.update_batches": (1, 100_000, "batches"),
    "scale.buffer_size": (1, 10_000_000, "views"),
    "scale.prefill_steps": (0, 10_000_000, "collection steps"),
    "scale.eval_every": (1, 1_000_000, "epochs"),
    "scale.eval_scenes": (1, 100_000, "scenes"),
    "scale.batch_size": (1, 100_000, "views"),
    "scale.accumulate": (1, 100_000, "micro-batches"),
    "scale.hrnet_accumulate": (1, 100_000, "micro-batches"),
    "scale.epochs": (1, 10**9, "epochs"),
    "scale.learning_rate": (0.0, 10.0, ""),
    "scale.final_learning_rate": (0.0, 10.0, ""),
    "scale.hrnet_final_learning_rate": (0.0, 10.0, ""),
    "scale.unit_width": (1, 1024, "channels"),
    "scale.height_jitter": (0.0, 0.5, ""),
    "scale.postprocess_dilation": (0.0, 2.0, "m"),
    "scale.hflip_probability": (0.0, 1.0, ""),
    "scale.encoder_shrink": (1, 64, ""),
    "scale.viewpoint_sets": (1, 10_000, ""),
    "scale.orientations": (1, 1000, ""),
    "scale.hrnet_epochs": (1, 10**9, "epochs"),
    "scale.hrnet_max_epochs": (1, 10**9, "epochs"),
    "scale.hrnet_eval_every": (1, 1_000_000, "epochs"),
    "scale.workers": (0, 1024, "processes"),
    "trainer.max_epochs": (1, 10**9, "epochs"),
    "trainer.devices": (1, 1024, "devices"),
    "trainer.num_nodes": (1, 10_000, "hosts"),
}
"""Lower bound, upper bound and unit of numeric keys. Integer bounds require a whole number."""

CELL_WIDTH = (0.1, 100.0, "m")
"""Range of the values in scale.cell_widths."""

MICRO_BATCH_KEYS = {"maps": "scale.accumulate", "images": "scale.hrnet_accumulate"}
"""Key of the number of micro-batches of a batch, by the type of the prediction."""

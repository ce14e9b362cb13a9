"""Replay-buffer callback, which checks the settings of the data module's replay buffer and logs its state."""

from dataclasses import asdict

from lightning import Callback, LightningModule, Trainer

from imagination.data.datamodule import SceneData
from imagination.data.replay_buffer import ReplaySettings
from imagination.utils.errors import UserError


class ReplayBufferCallback(Callback):
    """Callback that logs the state of the replay buffer, which the data module fills and draws batches from.

    Its arguments are the settings of the run, `callbacks.replay_buffer.*`. The config of the data module refers to
    them; at the start of a training the callback checks that the data module has the same.

    Args:
        size: capacity of the buffer, views.
        update_interval: number of collection steps per epoch; a step is one view in each parallel scene.
        update_batches: number of batches per epoch.
        aggregation_factor: fraction of older views in a batch; the rest comes from the newest collection.
        prefill_steps: number of collection steps before the first epoch, a multiple of `update_interval`.
        collection_epochs: number of epochs that collect views; see `ReplaySettings`.

    Raises:
        UserError: if a value is out of range.
    """

    def __init__(
        self,
        size: int,
        update_interval: int,
        update_batches: int,
        aggregation_factor: float,
        prefill_steps: int,
        collection_epochs: int,
    ) -> None:
        self.settings = ReplaySettings(
            size, update_interval, update_batches, aggregation_factor, prefill_steps, collection_epochs
        )

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        replay = getattr(trainer.datamodule, "replay", None)  # type: ignore[attr-defined]
        for name, value in asdict(self.settings).items():
            if (other := getattr(replay, name, None)) != value:
                raise UserError(
                    f"data.module.replay.{name}: got {other}, expected {value}, the value of "
                    f"callbacks.replay_buffer.{name}; set the latter only"
                )

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data: SceneData = trainer.datamodule  # type: ignore[attr-defined]
        collected = data.collected
        # arguments of the trainer such as limit_train_batches may skip batches
        batches = trainer.num_training_batches / data.micro_batches
        draws = batches * data.batch_size * (trainer.current_epoch + 1)
        pl_module.log("data/collecting_seconds", collected.seconds)
        pl_module.log("data/collected_views", float(collected.count))
        pl_module.log("data/draws_per_view", draws / collected.count)
        pl_module.log("data/buffer_fill", collected.fill)
        pl_module.log("data/view_age", collected.mean_age)

"""Checkpoint callbacks for run folders that can be moved."""

from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from imagination.runs.folder import COMPOSED
from imagination.utils.errors import UserError

PATHS = ("best_model_path", "kth_best_model_path", "last_model_path")
"""Keys of the callback state that hold paths."""


class MovableCheckpoint(ModelCheckpoint):
    """Lightning's ModelCheckpoint for run folders that may be moved.

    Its state holds absolute paths, and Lightning drops the best score if the folder differs when a run resumes. This
    state holds file names only. Files that are removed for better ones are in its folder, whatever the state in a
    checkpoint names.

    Raises:
        UserError: at the end of an epoch, if the run folder was deleted or moved during the training. Lightning would
            create a folder that holds only the checkpoints.
    """

    _has_config = False  # whether the folder is that of a run, with its config

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_start(trainer, pl_module)
        self._has_config = self._config.is_file()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._has_config and not self._config.is_file():
            folder = self._config.parent
            raise UserError(
                f"run folder {folder}: was deleted or moved during the training, so its checkpoints cannot be saved; "
                "move it back and resume the run, or start a new run"
            )
        super().on_train_epoch_end(trainer, pl_module)

    @property
    def _config(self) -> Path:
        """Path of the run's config, beside the folder of the checkpoints."""
        return Path(str(self.dirpath)).parent / COMPOSED

    def state_dict(self) -> dict[str, Any]:
        state = super().state_dict()
        names = {key: Path(state[key]).name for key in PATHS}
        best = {Path(path).name: score for path, score in state["best_k_models"].items()}
        return {**state, **names, "best_k_models": best, "dirpath": ""}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        def path_of(name: str) -> str:  # a file of this folder, whatever the checkpoint holds
            return str(Path(str(self.dirpath)) / Path(name).name) if Path(name).name.strip(".") else ""

        paths = {key: path_of(state_dict[key]) for key in PATHS}
        best = {path_of(name): score for name, score in state_dict["best_k_models"].items()}
        super().load_state_dict({**state_dict, **paths, "best_k_models": best, "dirpath": self.dirpath})


class BestCheckpoint(MovableCheckpoint):
    """Checkpoint callback of the epoch with the best validation score.

    - It has the last epoch validated, which is often the best: Lightning validates only multiples of
      `check_val_every_n_epoch`.
    - It saves at the end of epochs, where runs can be resumed exactly, and only of validated ones: Lightning would
      compare the score of an earlier validation again.
    """

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.current_epoch + 1 == trainer.max_epochs:
            trainer.check_val_every_n_epoch = 1

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if (trainer.current_epoch + 1) % (trainer.check_val_every_n_epoch or 1) == 0:
            super().on_train_epoch_end(trainer, pl_module)

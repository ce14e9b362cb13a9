"""Interface of scene sources: names, splits, loading and credits."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol, get_args, runtime_checkable

from imagination.scenes.scene import Scene

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)


class Credit(NamedTuple):
    """Attribution of a third-party model or data set.

    Attributes:
        split: split whose scenes may contain it.
        label: label of the object.
        model: name of the model, as in `SceneObject.model`.
        author, licence, origin: author, licence and origin.
    """

    split: str
    label: str
    model: str
    author: str
    licence: str
    origin: str


@runtime_checkable
class Credited(Protocol):
    """Scene source with third-party content, whose authors are named in the results."""

    def credits(self) -> Sequence[Credit]:
        """Return the attributions of all third-party content; may be empty."""


@runtime_checkable
class SceneSource(Protocol):
    """Source that loads scenes by name; picklable, so that each worker process gets a copy."""

    name: str

    def scenes(self, split: Split) -> list[str]:
        """Return the names of the scenes of a split in a fixed order; splits are disjoint.

        Raises:
            UserError: if the split has no scene.
        """

    def load(self, scene: str) -> Scene:
        """Load one scene; the same name always gives the same scene.

        Raises:
            UserError: if the scene does not exist, has no free space, or is damaged.
        """

    def identity(self, scene: str) -> str:
        """Return a string that stands for the scene itself, e.g. "procedural seed=0 train_0003".

        Evaluations compare it with the identities of the training scenes. It depends on the data set or the seed and on
        the name; not on code, settings, folders or times of files, nor on the split of a scan that may be in any split.
        """

    def fingerprint(self, scene: str) -> str:
        """Return a string that changes whenever data or settings change the result of `load`; part of cache keys.

        Cache keys also hold the code of the class, of the objects that it holds and of all modules that these import.
        """


@runtime_checkable
class SpareScenes(SceneSource, Protocol):
    """Source with additional scenes of training furniture, to measure the effect of unseen furniture."""

    def spare(self, count: int) -> list[str]:
        """Return the names of scenes that are furnished as in training and are in no split.

        Raises:
            UserError: if there are fewer than `count`.
        """

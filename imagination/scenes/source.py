"""The interface of scene sources: names, splits, loading and credits."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol, get_args, runtime_checkable

from imagination.scenes.scene import Scene

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)


class Credit(NamedTuple):
    """A model, or a data set, that somebody made.

    Attributes:
        split: whose scenes it may stand in.
        label: what it is.
        model: as `SceneObject.model` names it.
        author, licence, origin: who made it, under which terms it may be used, where it comes from.
    """

    split: str
    label: str
    model: str
    author: str
    licence: str
    origin: str


@runtime_checkable
class Credited(Protocol):
    """A scene source whose scenes hold what others made: results name them."""

    def credits(self) -> Sequence[Credit]:
        """Everything that scenes are made of; may be empty."""


@runtime_checkable
class SceneSource(Protocol):
    """Loads scenes by name. Plain values only inside, so that worker processes receive a copy of it."""

    name: str

    def scenes(self, split: Split) -> list[str]:
        """Names of the scenes of a split, in a fixed order; splits share no name.

        Raises:
            UserError: if the split has no scene.
        """

    def load(self, scene: str) -> Scene:
        """Load one scene; the same name always gives the same scene.

        Raises:
            UserError: if there is no such scene, it has no free space, or it is broken.
        """

    def fingerprint(self, scene: str) -> str:
        """A string that changes whenever what `load` returns changes; part of the keys of caches."""


@runtime_checkable
class SpareScenes(SceneSource, Protocol):
    """A source with more homes like those of training, for learning how much unseen furniture costs."""

    def spare(self, count: int) -> list[str]:
        """Names of scenes that are furnished as training's and in no split.

        Raises:
            UserError: if there are not so many.
        """

"""What a viewer is: shown every frame, closed at the end."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from imagination.mapping.semantic_mapper import SemanticMapper, Update


@runtime_checkable
class Viewer(Protocol):
    """Shows how a map is made."""

    def open(self, folder: Path, mapper: SemanticMapper) -> None:
        """Begin; files go into `folder`."""

    def show(self, stamp: int, update: Update) -> None:
        """Show a frame that was registered at `stamp`, nanoseconds."""

    def close(self) -> None:
        """End, also after an error."""


class NoViewer:
    """Shows nothing."""

    def open(self, folder: Path, mapper: SemanticMapper) -> None:
        pass

    def show(self, stamp: int, update: Update) -> None:
        pass

    def close(self) -> None:
        pass

"""Interface of viewers, which show every registered frame."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from imagination.mapping.semantic_mapper import SemanticMapper, Update


@runtime_checkable
class Viewer(Protocol):
    """Visualization of the mapping process."""

    def open(self, folder: Path, mapper: SemanticMapper) -> None:
        """Start; `folder` receives the output files."""

    def show(self, stamp: int, update: Update) -> None:
        """Show the update of a registered frame; `stamp` is its time in nanoseconds."""

    def close(self) -> None:
        """Finish; also called after an error."""


class NoViewer:
    """Viewer without output."""

    def open(self, folder: Path, mapper: SemanticMapper) -> None:
        pass

    def show(self, stamp: int, update: Update) -> None:
        pass

    def close(self) -> None:
        pass

"""Download and listing of the furniture of Sweet Home 3D."""

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from imagination.utils.cache import Cache
from imagination.utils.diagnostics import Finding
from imagination.utils.errors import UserError
from imagination_sweethome3d.catalogue import read_catalogue
from imagination_sweethome3d.furniture import (
    VARIABLE,
    assets_folder,
    candidates,
    entry_label,
    find_archives,
    split_designs,
)
from imagination_sweethome3d.homes import listing_of_homes

PACKAGE = "sweethome3d-furniture"
ALTERNATIVE = (
    f"install Debian's package {PACKAGE}, or put .sh3f archives from "
    f"https://www.sweethome3d.com/freeModels.jsp into a folder and set {VARIABLE} to it"
)


class FurniturePackage:
    """Debian's furniture package, unpacked into the assets folder without root."""

    def fetch(self) -> str:
        """Download and unpack the package unless its archives exist, and return a summary.

        Raises:
            UserError: if that fails; the message names other ways to get the archives.
        """
        try:
            archives = find_archives()
        except UserError:
            archives = self._download()
        return _summary(archives)

    def _download(self) -> tuple[Path, ...]:
        target = assets_folder() / "sweethome3d"
        for tool in ("apt-get", "dpkg"):
            if shutil.which(tool) is None:
                raise UserError(f"assets sweethome3d: the command {tool} was not found; {ALTERNATIVE}")
        with tempfile.TemporaryDirectory() as scratch:
            _run(["apt-get", "download", PACKAGE], scratch)
            packages = sorted(Path(scratch).glob(f"{PACKAGE}_*.deb"))
            if not packages:
                raise UserError(f"assets sweethome3d: apt-get downloaded no package; {ALTERNATIVE}")
            unpacked = Path(scratch) / "unpacked"
            _run(["dpkg", "-x", str(packages[-1]), str(unpacked)], scratch)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copytree(unpacked, target, dirs_exist_ok=True)
        return find_archives(str(target))

    def listing(self, folder: Path | None) -> list[str]:
        """Return a line for each furniture entry with its label, split and, if it is left out, the reason.

        Other entries are counted. For a folder of homes, return the label and model of each piece instead.
        """
        if folder is not None:
            return listing_of_homes(folder)
        archives = find_archives()
        with tempfile.TemporaryDirectory() as scratch:
            furniture = candidates(archives, Cache(scratch))
        split_of = {}
        for label in {candidate.label for candidate in furniture}:
            usable = [c.entry for c in furniture if c.label == label and not c.reason]
            for split, entries in split_designs(usable).items():
                split_of |= {(entry.archive, entry.id): split for entry in entries}
        lines = []
        for candidate in sorted(furniture, key=lambda c: (c.label, c.entry.id)):
            entry = candidate.entry
            status = split_of.get((entry.archive, entry.id), "") if not candidate.reason else "left out"
            notes = candidate.reason or "; ".join(candidate.notes)
            lines.append(
                f"{candidate.label:12} {status:8} {entry.id} ({entry.name}; {entry.creator}, {entry.licence})"
                + (f": {notes}" if notes else "")
            )
        for path in archives:
            catalogue = read_catalogue(path)
            lines += [f"{'?':12} left out {id} ({path.name}): {reason}" for id, reason in catalogue.problems]
            unlabelled = sum(entry_label(entry) is None for entry in catalogue.entries)
            lines.append(f"{path.name}: {len(catalogue.entries)} entries, {unlabelled} without a known label")
        used = sum(not candidate.reason for candidate in furniture)
        lines.append(f"{used} models in use, {len(furniture) - used} left out")
        return lines


def examine() -> Iterator[Finding]:
    """Check whether the furniture archives exist and can be read, for the doctor."""
    try:
        archives = find_archives()
    except UserError as error:
        yield Finding("furniture", None, f"{error} (only data/furniture=sweethome3d needs it)")
        return
    try:
        yield Finding("furniture", True, _summary(archives))
    except UserError as error:
        yield Finding("furniture", False, f"{error}; remove it")


def _summary(archives: tuple[Path, ...]) -> str:
    """Return the number of archives and pieces, and their folder.

    Raises:
        UserError: if a file is not a furniture archive, or holds no furniture.
    """
    count = sum(len(read_catalogue(path).entries) for path in archives)
    return f"{len(archives)} furniture archives of Sweet Home 3D with {count} pieces in {archives[0].parent}"


def _run(command: list[str], folder: str) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or [f"code {done.returncode}"])[-1]
        raise UserError(f"assets sweethome3d: {' '.join(command[:2])} failed: {last}; {ALTERNATIVE}")

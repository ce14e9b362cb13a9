"""Fetching Sweet Home 3D's furniture, and listing what becomes of it."""

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
ELSEWHERE = (
    f"install Debian's package {PACKAGE}, or put .sh3f archives from "
    f"https://www.sweethome3d.com/freeModels.jsp into a folder and set {VARIABLE} to it"
)


class FurniturePackage:
    """Debian's package of furniture, unpacked without root into the assets' folder."""

    def fetch(self) -> str:
        """Download and unpack the package unless its archives are there.

        Raises:
            UserError: if that fails, with how to get them elsewhere.
        """
        try:
            archives = find_archives()
        except UserError:
            archives = self._fetched()
        return _told(archives)

    def _fetched(self) -> tuple[Path, ...]:
        target = assets_folder() / "sweethome3d"
        for tool in ("apt-get", "dpkg"):
            if shutil.which(tool) is None:
                raise UserError(f"assets sweethome3d: there is no {tool} here; {ELSEWHERE}")
        with tempfile.TemporaryDirectory() as scratch:
            _run(["apt-get", "download", PACKAGE], scratch)
            packages = sorted(Path(scratch).glob(f"{PACKAGE}_*.deb"))
            if not packages:
                raise UserError(f"assets sweethome3d: apt-get downloaded nothing; {ELSEWHERE}")
            unpacked = Path(scratch) / "unpacked"
            _run(["dpkg", "-x", str(packages[-1]), str(unpacked)], scratch)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copytree(unpacked, target, dirs_exist_ok=True)
        return find_archives(str(target))

    def listing(self, folder: Path | None) -> list[str]:
        """Every entry that is furniture of a known label: its split, or why it is left out; others are counted.

        Of a folder of homes, what each piece became.
        """
        if folder is not None:
            return listing_of_homes(folder)
        archives = find_archives()
        with tempfile.TemporaryDirectory() as scratch:
            found = candidates(archives, Cache(scratch))
        split_of = {}
        for label in {candidate.label for candidate in found}:
            fit = [c.entry for c in found if c.label == label and not c.reason]
            for split, entries in split_designs(fit).items():
                split_of |= {(entry.archive, entry.id): split for entry in entries}
        lines = []
        for candidate in sorted(found, key=lambda c: (c.label, c.entry.id)):
            entry = candidate.entry
            verdict = split_of.get((entry.archive, entry.id), "") if not candidate.reason else "left out"
            told = candidate.reason or "; ".join(candidate.notes)
            lines.append(
                f"{candidate.label:12} {verdict:8} {entry.id} ({entry.name}; {entry.creator}, {entry.licence})"
                + (f": {told}" if told else "")
            )
        for path in archives:
            catalogue = read_catalogue(path)
            lines += [f"{'?':12} left out {id} ({path.name}): {reason}" for id, reason in catalogue.problems]
            other = sum(entry_label(entry) is None for entry in catalogue.entries)
            lines.append(
                f"{path.name}: {len(catalogue.entries)} entries, {other} of them of no label that homes know"
            )
        used = sum(not candidate.reason for candidate in found)
        lines.append(f"{used} models in use, {len(found) - used} left out")
        return lines


def examine() -> Iterator[Finding]:
    """Whether the furniture is there and can be read, for the doctor."""
    try:
        archives = find_archives()
    except UserError as error:
        yield Finding("furniture", None, f"{error} (only data/furniture=sweethome3d needs it)")
        return
    try:
        yield Finding("furniture", True, _told(archives))
    except UserError as error:
        yield Finding("furniture", False, f"{error}; remove it")


def _told(archives: tuple[Path, ...]) -> str:
    """How much furniture there is.

    Raises:
        UserError: if an archive is none, or holds no furniture.
    """
    count = sum(len(read_catalogue(path).entries) for path in archives)
    where = archives[0].parent
    return f"{len(archives)} furniture archives of Sweet Home 3D with {count} pieces in {where}"


def _run(command: list[str], folder: str) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or [f"code {done.returncode}"])[-1]
        raise UserError(f"assets sweethome3d: {' '.join(command[:2])} failed: {last}; {ELSEWHERE}")

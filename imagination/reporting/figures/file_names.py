"""File names of figures: names of categories and swept keys come from files and can contain any character."""

import hashlib
import re
from collections.abc import Iterable

MAX_LENGTH = 50
"""Maximum length of a file name without its suffix."""


def safe_names(stems: Iterable[str]) -> dict[str, str]:
    """Return a distinct file name without suffix for each stem.

    A stem that is changed, or that differs from another one only in its case, gets a part of its hash, so that two
    figures never share a file on any file system.
    """
    names: dict[str, str] = {}
    lowered: set[str] = set()
    for stem in dict.fromkeys(stems):
        name, hashed = re.sub(r"[^\w.+-]", "_", stem)[:MAX_LENGTH], stem
        while name != stem and hashed == stem or name.lower() in lowered:
            hashed = hashlib.sha256(hashed.encode()).hexdigest()
            name = f"{name[: MAX_LENGTH - 9]}_{hashed[:8]}"
        names[stem] = name
        lowered.add(name.lower())
    return names

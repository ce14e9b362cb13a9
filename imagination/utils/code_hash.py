"""Hash of source code, by which cached results of older code are recognised."""

import hashlib
from collections.abc import Iterable
from pathlib import Path


def code_hash(*paths: Path, versions: Iterable[str] = ()) -> str:
    """Return the SHA-256 of Python files.

    Args:
        paths: files, or folders whose Python files are included recursively.
        versions: versions of libraries that decide the results as well.
    """
    digest = hashlib.sha256()
    for text in versions:
        digest.update(text.encode())
    for path in paths:
        for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()

"""File names of scenes and other objects with arbitrary names."""

import hashlib
import re

SAFE = re.compile(r"\w[\w.+-]{0,99}", re.ASCII)
"""Pattern of names that are file names as they are."""

HASHED = re.compile(r".*-[0-9a-f]{16}")
"""Pattern of file names that end with a hash."""

MAX_LENGTH = 80
"""Maximum length of a file name without its hash, characters."""


def file_name(name: str) -> str:
    """Return a file name for any name, e.g. that of a scene, which may be a path; different names have different ones.

    A name of letters, digits and _ . + - is its own file name. In others, further characters are replaced and a hash of
    the name is appended.

    >>> file_name("test_0003"), file_name("/scans/a.glb")
    ('test_0003', 'scans_a.glb-5021acce9f392211')
    """
    if SAFE.fullmatch(name) and not HASHED.fullmatch(name):
        return name
    readable = re.sub(r"[^\w.+-]+", "_", name, flags=re.ASCII).strip("._+-")[:MAX_LENGTH]
    digest = hashlib.sha256(name.encode(errors="surrogatepass")).hexdigest()
    return f"{readable or '_'}-{digest[:16]}"

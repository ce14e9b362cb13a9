"""Writer of a new plugin from the template in `plugin_template/`."""

import keyword
import os
import re
import unicodedata
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from imagination.config.plugin_registry import core_conf, discover, options_of
from imagination.utils.atomic_io import PART
from imagination.utils.errors import CannotWriteError, UserError

TEMPLATE = Path(__file__).with_name("plugin_template")
"""Folder of the template: Jinja templates with the variable `name`; NAME in a path is replaced by the name."""

SUFFIX = ".j2"
"""Suffix of the files of the template."""

VALUES = ("true", "false", "null", "nan", "inf")
"""Words that Hydra reads as values instead of text."""

MAX_LENGTH = 40
"""Maximum length of the name of a plugin, characters."""

NEXT_STEPS = """
Next:
    python -m imagination.plugins check=true
    python -m pytest plugins/{name}
    python -m imagination.train experiment={name}_chair scale=test
plugins/{name}/README.md describes the files."""
"""Message after a plugin is written."""


def write_plugin(name: object) -> list[Path]:
    """Write a plugin to plugins/<name>/ in the current directory, completely or not at all.

    Returns:
        the files, relative to the current directory.

    Raises:
        UserError: if the name is invalid or in use, or the files cannot be written.
    """
    valid = check_plugin_name(name)
    folder = Path("plugins", valid)
    texts = rendered(valid)
    _check_unused(valid, folder, texts)
    try:
        folder.parent.mkdir(exist_ok=True)
        # plugins are not searched in folders whose name begins with a dot
        with TemporaryDirectory(prefix=f".{valid}.", suffix=PART, dir=folder.parent) as scratch:
            for path, text in texts.items():
                file = Path(scratch, valid, path)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text)
            os.rename(Path(scratch, valid), folder)
    except OSError as error:
        raise CannotWriteError(
            f"new: could not write {folder}: {error.strerror or error}; free some space, or run the command in a "
            "folder in which you may write"
        ) from error
    return [folder / path for path in texts]


def check_plugin_name(name: object) -> str:
    """Return the name of a plugin if it is valid.

    Raises:
        UserError: if it is not, with a similar name that is.
    """
    if isinstance(name, str) and name == similar_name(name):
        return name
    raise UserError(
        f"new: got {name!r}, expected at most {MAX_LENGTH} lower-case letters (a to z), digits and single underscores, "
        f"beginning with a letter, and no keyword of Python or value such as true; try new={similar_name(str(name))}"
    )


def similar_name(text: str) -> str:
    """Return the valid name of a plugin that is closest to a text; a valid name is returned unchanged.

    >>> [similar_name(text) for text in ("My-Plugin", "BoxRooms", "3rooms", "class", "Möbel", "?")]
    ['my_plugin', 'box_rooms', 'rooms', 'class_plugin', 'mobel', 'my_plugin']
    """
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z0-9]+", plain)
    name = "_".join(words).lower().lstrip("0123456789_")[:MAX_LENGTH].rstrip("_") or "my_plugin"
    return f"{name}_plugin" if keyword.iskeyword(name) or name in VALUES else name


def rendered(name: str) -> dict[str, str]:
    """Return the text of each file of a new plugin, by its path in the plugin."""
    from jinja2 import StrictUndefined, Template  # the list of plugins does without it

    texts = {}
    for file in sorted(TEMPLATE.rglob(f"*{SUFFIX}")):
        path = file.relative_to(TEMPLATE).as_posix().removesuffix(SUFFIX).replace("NAME", name)
        template = Template(file.read_text(), undefined=StrictUndefined, keep_trailing_newline=True)
        texts[path] = template.render(name=name)
    return texts


def _check_unused(name: str, folder: Path, paths: Iterable[str]) -> None:
    """Check that no file, plugin, option or package has a name of the new plugin."""
    if os.path.lexists(folder):
        raise UserError(
            f"new: got {name!r}, but {folder} exists, expected the name of a new folder; choose another name"
        )
    plugins = discover()
    owners = dict.fromkeys(options_of(core_conf()), "the core")
    owners |= {option: plugin.origin for plugin in plugins for option in plugin.options}
    for plugin in plugins:
        if plugin.name == name:
            raise UserError(
                f"new: got {name!r}, the name of the plugin in {plugin.origin}; choose another name"
            )
    for option in (path.removeprefix("conf/").removesuffix(".yaml") for path in paths):
        if option in owners:
            raise UserError(
                f"new: got {name!r}, whose option {option!r} exists already in {owners[option]}; choose another name"
            )
    packages = {package for plugin in plugins for package in plugin.packages}
    if f"imagination_{name}" in packages or find_spec(f"imagination_{name}") is not None:
        raise UserError(
            f"new: got {name!r}, but the package imagination_{name} is installed already; choose another name"
        )

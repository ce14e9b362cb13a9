"""Refuse configuration keys, options and arguments of earlier versions, with the new form."""

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence

from imagination.config.key_roles import KEYS
from imagination.config.overrides import assignment
from imagination.utils.errors import UserError

RENAMED_KEYS: Mapping[str, str] = {old: key for key, row in KEYS.items() for old in row.old}
"""Current names of keys and nodes by old name."""

RENAMED_PATTERNS: Mapping[str, str] = {
    r"evaluation\.approaches\.(\w+)\.finish": r"evaluation.approaches.\1.postprocess",
    r"categories\.(\w+)\.members": r"categories.\1.aliases",
    r"model\.(unit|module)\.(.*\.)?mirrored_answers": r"model.\1.\2tta_hflip",
    r"model\.(unit|module)\.(.*\.)?dilated_answers": r"model.\1.\2postprocess_dilation",
}
"""New names of keys with a variable part."""

RENAMED_VALUES: Mapping[tuple[str, str], str] = {
    ("postprocess", "keep"): "none",
    ("postprocess", "grow"): "dilate",
    ("postprocess", "truth"): "ground_truth",
    ("needs", "plain_maps"): "raw_maps",
}
"""New values, by the last part of today's key and the old value."""

RENAMED_OPTIONS: Mapping[tuple[str, str], str] = {
    ("scale", "desk"): "small",
    ("mapping/registration", "overwrite"): "latest",
    ("callbacks", "pictures"): "unit_images",
    ("callbacks", "segmentation_pictures"): "segmentation_images",
    ("callbacks", "record"): "training_stats",
    ("callbacks", "seeding"): "seed_per_epoch",
    ("callbacks", "progress"): "progress_bar",
    ("callbacks", "until_flat"): "early_stopping",
}
"""New names of options, by group and old name."""

REMOVED_KEYS: Mapping[tuple[str, ...], Mapping[str, str]] = {
    ("map", "serve"): {
        "limits": "the limits of the robot's camera are constants of imagination.mapping.semantic_mapper",
        "max_speed": "the largest speed of a pose is a constant of imagination.recordings.pose_filters",
    },
    ("export",): {
        "look_once": "an exported unit predicts as its checkpoint does (model.tta_hflip in training)",
        "tolerance": "the tolerance of an exported unit is a constant of imagination.deployment.export",
        "max_loss": "the allowed loss of IoU is a constant of imagination.deployment.export",
    },
    ("train", "evaluate", "study"): {
        "evaluation.approaches.imagination_dilated": "its rows repeated those of imagination in every table",
    },
}
"""Keys of commands that are gone, with the reason."""

POSITIONAL_KEYS: Mapping[str, str] = {"report": "folder", "assets": "name"}
"""Key that replaces a word without a key, by command."""

OPTION_KEYS: Mapping[tuple[str, str], str] = {("report", "--docs"): "docs"}
"""Key that replaces an option with a value, by command and option."""

FLAGS: Mapping[tuple[str, str], str] = {("map", "--preview"): "viewer=preview"}
"""Override that replaces an option without a value, by command and option."""


def check_renamed(command: str, overrides: Iterable[str]) -> None:
    """Check that a command line uses no key, option or argument of an earlier version.

    Args:
        command: name of the command, such as "train".
        overrides: words of a command line.

    Raises:
        UserError: with the old name and the new one.
    """
    words = list(overrides)
    if (new_words := as_overrides(command, words)) != words:
        raise UserError(
            f"{command}: got {shlex.join(words)}, expected key=value: python -m imagination.{command} "
            f"{shlex.join(new_words)}"
        )
    for text in words:
        name, equals, value = text.lstrip("+~").partition("=")
        if not (equals or text.startswith("~")) or not re.match(r"[A-Za-z]", name):
            continue
        group = name.partition("@")[0]
        for option in re.split(r"[\[\], ]+", value):
            if new := RENAMED_OPTIONS.get((group, option)):
                raise UserError(f"{name}: got {option!r}, which was renamed; expected {name}={new}")
        if command == "render" and name == "shards":
            raise UserError(
                f"shards: got {text!r}, which is another command now; expected "
                f"python -m imagination.prepare_shards shards={value}"
            )
        new_name = renamed(name)
        new_value = RENAMED_VALUES.get((new_name.rpartition(".")[2], value), value)
        if (new_name, new_value) != (name, value):
            raise UserError(f"{name}: was renamed; got {text!r}, expected {new_name}{equals}{new_value}")
        removed = (keys for commands, keys in REMOVED_KEYS.items() if command in commands)
        for key, reason in (item for keys in removed for item in keys.items()):
            if name == key or name.startswith(f"{key}."):
                raise UserError(f"{name}: was removed; got {text!r}, expected no such key: {reason}")


def renamed(key: str) -> str:
    """Return today's name of a dotted key.

    >>> renamed("scale.homes.train"), renamed("callbacks.until_flat.margin"), renamed("seed")
    ('data.splits.train', 'callbacks.early_stopping.min_delta', 'seed')
    """
    parts = key.split(".")
    for count in range(len(parts), 0, -1):  # the longest old name that contains the key
        if new := RENAMED_KEYS.get(".".join(parts[:count])):
            return ".".join([new, *parts[count:]])
    for pattern, replacement in RENAMED_PATTERNS.items():
        key = re.sub(rf"^{pattern}(?=\.|$)", replacement, key)
    return key


def as_overrides(command: str, words: Sequence[str]) -> list[str]:
    """Return a command line with the arguments of earlier versions as overrides, apart from values of Hydra's options.

    >>> as_overrides("report", ["outputs/made/latest", "--docs", "docs/study"])
    ['folder=outputs/made/latest', 'docs=docs/study']
    """
    result: list[str] = []
    before = ""
    for word in words:
        option, equals, value = word.partition("=")
        if key := OPTION_KEYS.get((command, before)):
            result[-1] = assignment(key, word)
        elif key := OPTION_KEYS.get((command, option)):
            result.append(assignment(key, value or "PAGE"))
        elif (key := POSITIONAL_KEYS.get(command)) and not (equals or word[:1] in "-~" or before[:1] == "-"):
            result.append(assignment(key, word))
        else:
            result.append(FLAGS.get((command, word), word))
        before = "" if equals else word  # an option with its value takes no other word
    return result

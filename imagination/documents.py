"""YAML files that may come from a stranger."""

from pathlib import Path
from typing import Any

import yaml

from imagination.errors import UserError


def read_yaml(path: Path, expected: str) -> dict[str, Any]:
    """Keys and values in a YAML file.

    Args:
        path: of the file.
        expected: what the keys are, for the message.

    Raises:
        UserError: if it is missing, damaged or holds something else.
    """
    try:
        text = path.read_text()
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):  # a few could mean gigabytes
            raise yaml.YAMLError("it holds aliases")
        values = yaml.safe_load(text)
    except FileNotFoundError as error:
        raise UserError(f"{path}: there is no such file") from error
    except Exception as error:  # yaml raises anything on what looks like a date or a number
        raise UserError(f"{path}: cannot be read ({' '.join(str(error).split())})") from error
    if not isinstance(values, dict):
        raise UserError(f"{path}: got {type(values).__name__}, expected {expected}")
    return values

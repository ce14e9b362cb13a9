"""Messages for errors that the user can correct."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from imagination.utils.errors import UserError

EXTRAS: Mapping[str, str] = {"hydra/launcher/joblib": "joblib", "hydra/sweeper/optuna": "optuna"}
"""Options that come with an extra of the project."""


@contextmanager
def user_errors_reported() -> Iterator[None]:
    """End the program with one message and exit code 2 on an error that is the user's to mend.

    Both around a task and around Hydra, which would announce the task's errors in its own way.
    """
    try:
        yield
    except KeyboardInterrupt:  # before a command has anything that could go on
        print("Interrupted", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if (message := explain(error)) is None:
            raise
        print(f"error: {message}", file=sys.stderr)
        sys.exit(2)


def explain(error: BaseException) -> str | None:
    """What to tell the user about an error that is theirs to mend; None if it is the program's."""
    if not isinstance(error, (UserError, HydraException, OmegaConfBaseException)):
        return None
    causes = list(_causes(error))
    for cause in causes:
        if isinstance(cause, UserError):  # the builder of some part raised it, Hydra wrapped it
            return str(cause)
    if any(not isinstance(cause, (HydraException, OmegaConfBaseException, ImportError)) for cause in causes):
        return None
    texts = dict.fromkeys(str(cause).partition("\nConfig search path")[0].strip() for cause in causes)
    told = "\n".join(text for text in texts if not any(text in other for other in texts if other != text))
    missing = [extra for option, extra in EXTRAS.items() if f"'{option}'" in told]
    return "\n".join([told, *(f"Install it: pip install 'imagination[{extra}]'" for extra in missing)])


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__

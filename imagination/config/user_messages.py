"""Messages for errors that the user can correct."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from imagination.utils import interrupts
from imagination.utils.errors import UserError, install_command

EXTRAS: Mapping[str, str] = {
    "hydra/launcher/joblib": "joblib",
    "hydra/launcher/submitit_local": "slurm",
    "hydra/launcher/submitit_slurm": "slurm",
    "hydra/sweeper/optuna": "optuna",
}
"""Extras of the project that install config options of Hydra."""


@contextmanager
def user_errors_reported() -> Iterator[None]:
    """Exit with one message and code 2 on an error that the user can correct.

    This context wraps the task, and Hydra as well, which would otherwise print the errors of the task itself.
    """
    try:
        yield
    except KeyboardInterrupt:
        interrupts.report()  # unless the run has reported how it is resumed
        sys.exit(interrupts.exit_code())
    except Exception as error:
        if (message := explain(error)) is None:
            raise
        print(f"error: {message}", file=sys.stderr)
        sys.exit(2)


def explain(error: BaseException) -> str | None:
    """Return the message for an error that the user can correct, or None for an error of the program."""
    if not isinstance(error, (UserError, HydraException, OmegaConfBaseException)):
        return None
    causes = list(_causes(error))
    for cause in causes:
        if isinstance(cause, UserError):  # raised by a constructor and wrapped by Hydra
            return str(cause)
    if any(not isinstance(cause, (HydraException, OmegaConfBaseException, ImportError)) for cause in causes):
        return None
    texts = dict.fromkeys(str(cause).partition("\nConfig search path")[0].strip() for cause in causes)
    message = "\n".join(text for text in texts if not any(text in other for other in texts if other != text))
    missing = [extra for option, extra in EXTRAS.items() if f"'{option}'" in message]
    return "\n".join([message, *(f"Install it with: {install_command(extra)}" for extra in missing)])


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__

"""A robot's camera from plain values, as in conf/recording and in camera.yaml of a plain folder."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from imagination.geometry.camera import Camera
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.utils.errors import UserError


def camera_of(values: Mapping[str, Any], origin: str = "camera") -> RgbdCamera:
    """A robot's camera from plain values, angles in degrees.

    Raises:
        UserError: on a missing, unknown or impossible value.
    """
    values = dict(values)
    try:
        colour = intrinsics_of(values.pop("colour"))
        depth = intrinsics_of(given) if (given := values.pop("depth", None)) else None
        given = values.pop("depth_to_colour", None)
        beside = np.eye(4) if given is None else np.array(given, np.float64)
        height, tilt = (
            float(values.pop("mount_height", 1.25)),
            [float(values.pop(name, 0.0)) for name in ("pitch", "roll")],
        )
        if values:
            raise UserError(f"{origin}: got the unknown keys {', '.join(map(str, values))}")
        return RgbdCamera(colour, depth, beside, height, *np.deg2rad(tilt).tolist())
    except KeyError as error:
        raise UserError(f"{origin}: has no {error}") from error
    except UserError:
        raise
    except (TypeError, AttributeError, ValueError) as error:
        raise UserError(f"{origin}: holds a value that cannot be read ({error})") from error


def intrinsics_of(values: Mapping[str, Any]) -> Intrinsics:
    """Intrinsics from plain values; see `camera_of`."""
    return Intrinsics(**{**values, "distortion": tuple(values.get("distortion") or ())})


def mount_of(values: Mapping[str, Any]) -> tuple[str, Float64[np.ndarray, "4 4"]]:
    """Where a camera sits on a robot that does not say so itself: the robot's frame, and the transform to it.

    Args:
        values: frame, height above it in metres, pitch and roll in degrees.

    Raises:
        UserError: if one is missing, unknown or impossible.
    """
    known = {"frame", "height", "pitch", "roll"}
    try:
        frame, height = str(values["frame"]), float(values["height"])
        tilt = np.deg2rad([float(values.get("pitch", 0.0)), float(values.get("roll", 0.0))]).tolist()
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"mount: got {values}, expected frame, height in metres, pitch and roll in degrees"
        ) from error
    if unknown := values.keys() - known:
        raise UserError(
            f"mount: got the unknown keys {', '.join(sorted(unknown))}, expected {', '.join(sorted(known))}"
        )
    return frame, Camera(8, 8, 1.0, height, *tilt).to_robot()

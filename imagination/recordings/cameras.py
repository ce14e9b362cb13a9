"""Robot cameras from plain values of conf/recording or of camera.yaml in a plain folder."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from imagination.geometry.camera import Camera
from imagination.geometry.rgbd import Intrinsics, RgbdCamera
from imagination.utils.errors import UserError


def camera_of(values: Mapping[str, Any], origin: str = "camera") -> RgbdCamera:
    """Build a robot's camera from plain values, angles in degrees.

    Raises:
        UserError: if a value is missing, unknown or out of range.
    """
    values = dict(values)
    try:
        colour = intrinsics_of(values.pop("colour"))
        depth = intrinsics_of(entry) if (entry := values.pop("depth", None)) else None
        matrix = values.pop("depth_to_colour", None)
        depth_to_colour = np.eye(4) if matrix is None else np.array(matrix, np.float64)
        height, tilt = (
            float(values.pop("mount_height", 1.25)),
            [float(values.pop(name, 0.0)) for name in ("pitch", "roll")],
        )
        if values:
            raise UserError(f"{origin}: got the unknown keys {', '.join(map(str, values))}")
        return RgbdCamera(colour, depth, depth_to_colour, height, *np.deg2rad(tilt).tolist())
    except KeyError as error:
        raise UserError(f"{origin}: key {error} is missing") from error
    except UserError:
        raise
    except (TypeError, AttributeError, ValueError) as error:
        raise UserError(f"{origin}: a value cannot be read ({error})") from error


def intrinsics_of(values: Mapping[str, Any]) -> Intrinsics:
    """Build intrinsics from plain values; see `camera_of`."""
    return Intrinsics(**{**values, "distortion": tuple(values.get("distortion") or ())})


def mount_of(values: Mapping[str, Any]) -> tuple[str, Float64[np.ndarray, "4 4"]]:
    """Return the robot's frame and the transform from the camera to it, for robots that do not publish it.

    Args:
        values: frame, height of the camera above it in metres, pitch and roll in degrees.

    Raises:
        UserError: if a value is missing, unknown or out of range.
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

"""Lenses that a format cannot carry are refused, not rounded."""

from calibgraph.errors import CalibrationError
from calibgraph.model.rig import Camera


def carried_coefficients(name: str, camera: Camera, most: int, what: str) -> list[float]:
    """A pinhole's coefficients, ``most`` of them, in OpenCV's order."""
    padded = [*camera.distortion, *[0.0] * most]
    if any(padded[most:]):
        raise CalibrationError(
            f"camera {name!r}: {what} holds {most or 'no'} distortion coefficients, this lens has "
            f"{camera.distortion}; choose another --format (opencv, json)",
            camera=name,
        )
    return padded[:most]


def no_place_for(name: str, camera: Camera, what: str) -> CalibrationError:
    """The error of a format that has no place for a camera's lens model."""
    return CalibrationError(
        f"camera {name!r}: {what} cannot hold a lens of the model {camera.model}; choose another "
        "--format (opencv, json)",
        camera=name,
    )


def require_undistorted(name: str, camera: Camera, what: str) -> None:
    """Check that a camera is a pinhole without distortion."""
    if camera.model != "pinhole":
        raise CalibrationError(
            f"camera {name!r}: {what} cannot hold a {camera.model} lens; choose another --format, "
            "or undistort the images and calibrate these",
            camera=name,
        )
    carried_coefficients(name, camera, 0, what)

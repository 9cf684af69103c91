"""The calib.txt of KITTI odometry, of undistorted cameras."""

import re

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError
from calibgraph.io.formats.rig_export import RigExport, require_undistorted

_SAME = 1e-9  # of rotation matrices: rounding in double precision
_MOST = 4


def write_kitti(export: RigExport) -> str:
    """P_k = K [I | b] per camera and Tr; without comments, at which readers of others stop.

    Raises:
        CalibrationError: if a lens is distorted, or cameras differ in their rotation.
    """
    numbers = _numbers(export)
    first, *_ = export.cameras.values()
    Tr = first.T_camera_lidar[:3]
    lines = []
    for name, camera in export.cameras.items():
        require_undistorted(name, camera, "KITTI's calib.txt")
        if np.abs(camera.T_camera_lidar[:3, :3] - Tr[:, :3]).max() > _SAME:
            raise CalibrationError(
                f"camera {name!r}: KITTI's calib.txt has one rotation for all cameras, and this "
                "one differs from the first; write one file per camera with --camera",
                camera=name,
            )
        b = camera.T_camera_lidar[:3, 3:] - Tr[:, 3:]
        P = camera.matrix_px @ np.hstack([np.eye(3), b])
        lines.append(_line(f"P{numbers[name]}", P))
    return "".join([*sorted(lines), _line("Tr", Tr)])


def kitti_statement(export: RigExport) -> list[str]:
    """The direction, for a file beside calib.txt."""
    numbers = _numbers(export)
    return export.statement(
        "calib.txt: the pixel of p_lidar is P_k * [Tr; 0 0 0 1] * p_lidar, with P_k = K [I | b]; "
        "Tr maps LiDAR to rectified camera coordinates",
        "T_camera_lidar of camera k is Tr with K^-1 P_k[:, 3] added to its translation",
        f"cameras: {', '.join(f'{name} is P{k}' for name, k in numbers.items())}",
    )


def _numbers(export: RigExport) -> dict[str, int]:
    """The k of P_k per camera: the number in image_k, else its place in the order."""
    found = {name: re.fullmatch(r"image_0?([0-3])", name) for name in export.cameras}
    numbers = {name: int(match[1]) for name, match in found.items() if match}
    if len(set(numbers.values())) == len(export.cameras):
        return numbers
    if len(export.cameras) > _MOST:
        raise CalibrationError(
            f"KITTI's calib.txt holds {_MOST} cameras, these are {len(export.cameras)}; choose "
            "some with --camera"
        )
    return {name: k for k, name in enumerate(export.cameras)}


def _line(key: str, matrix: NDArray[np.float64]) -> str:
    return f"{key}: {' '.join(repr(float(value)) for value in matrix.ravel())}\n"

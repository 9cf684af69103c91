"""Point clouds in .las and .laz files, by laspy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError, FileError

_CHUNK = 1_000_000


def read_las(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """(n, 3) points [m] and (n,) intensities of a file of one scan, in the LiDAR frame.

    Raises:
        CalibrationError: if laspy is missing.
        FileError: if the file is damaged, or ends before its points.
    """
    try:
        import laspy
    except ImportError as error:
        raise CalibrationError(
            f"{path}: reading {path.suffix} needs laspy: pip install 'calibgraph[las]' ({error})"
        ) from error
    try:
        with laspy.open(path) as file:
            expected = file.header.point_count
            parts = [
                np.column_stack([chunk.x, chunk.y, chunk.z, chunk.intensity])
                for chunk in file.chunk_iterator(_CHUNK)
            ]
    except Exception as error:  # laspy's own, those of its decoders, and numpy's
        raise FileError(path, f"cannot be read as LAS ({error}); is it complete?") from error
    points = np.concatenate(parts) if parts else np.empty((0, 4))
    if len(points) != expected:
        raise FileError(path, f"is truncated: {len(points)} of {expected} points; write it again")
    return points[:, :3], points[:, 3]

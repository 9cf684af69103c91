"""The results that are compared: read, named, and checked to be of one rig."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

from calibgraph.errors import CalibrationError
from calibgraph.io.calibrations import load_calibration
from calibgraph.model.calibration import Calibration
from calibgraph.model.result_files import CALIBRATION_FILE

Result: TypeAlias = Calibration | Path | str
Results: TypeAlias = Sequence[Result] | Mapping[str, Result]


def open_results(given: Results, *, own_lenses: bool) -> dict[str, Calibration]:
    """The results by their names: those given, of files the paths below their common folder.

    Raises:
        FileError: if one cannot be read.
        CalibrationError: if there are fewer than two, or they are not of one rig.
    """
    names = [*given] if isinstance(given, Mapping) else _names(given)
    items = [*given.values()] if isinstance(given, Mapping) else [*given]
    loaded = [item if isinstance(item, Calibration) else load_calibration(item) for item in items]
    if len(loaded) < 2:  # noqa: PLR2004 - a comparison
        raise CalibrationError(f"{len(loaded)} result given; a comparison needs two or more")
    seen: dict[bytes, str] = {}
    for name, result in zip(names, loaded, strict=True):
        extrinsics = b"".join(T.tobytes() for _, T in sorted(result.T_camera_lidar.items()))
        if extrinsics in seen:  # equal to the last bit: a copy
            raise CalibrationError(
                f"{name}: is the same result as {seen[extrinsics]}; give each once"
            )
        seen[extrinsics] = name
        _require_same_rig(names[0], loaded[0], name, result, own_lenses=own_lenses)
    return dict(zip(names, loaded, strict=True))


def _names(given: Sequence[Result]) -> list[str]:
    """Paths below the common folder; of results in memory their places, from 1."""
    paths = [Path(item).resolve() for item in given if not isinstance(item, Calibration)]
    if len(paths) < len(given) or not paths:
        return [f"result {place}" for place in range(1, len(given) + 1)]
    ends = [path.parent if path.name == CALIBRATION_FILE else path for path in paths]
    if len(set(ends)) < len(ends):
        return [str(item) for item in given]
    common = os.path.commonpath([end.parent for end in ends])
    return [str(end.relative_to(common)) for end in ends]


def _require_same_rig(
    first: str, one: Calibration, name: str, two: Calibration, *, own_lenses: bool
) -> None:
    """Check that two results have the same cameras."""
    a, b = one.rig.cameras, two.rig.cameras
    if a.keys() != b.keys():
        raise CalibrationError(
            f"{name}: has the cameras {', '.join(b)}, {first} has {', '.join(a)}; give results of "
            "one rig"
        )
    for camera, other in b.items():
        parts = {"T_camera_lidar"} | ({"intrinsics_px", "distortion"} if own_lenses else set())
        if other.model_dump(exclude=parts) != a[camera].model_dump(exclude=parts):
            raise CalibrationError(
                f"{name}: camera {camera} has another image size or lens than in {first}, which "
                "would look like a motion; calibrate both with one lens, or give --own-lenses if "
                "they are several vehicles, each with lenses calibrated by themselves"
            )

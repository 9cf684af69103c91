"""The frames of a result: what it was made from, and where the files are now."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.errors import DatasetError
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame, hash_source
from calibgraph.model.calibration import Calibration


def recording_name(result: Calibration) -> str:
    """What a result was made from, in short: the last two folders of its recordings, or its table.

    Returns:
        The names; empty if the result names no files.
    """
    if not result.frames:
        return Path(next(iter(result.inputs), "")).name
    found = {os.path.commonpath([e["cloud"], *e["images"].values()]) for e in result.frames}
    return ", ".join("/".join(Path(each).parts[-2:]) for each in sorted(found))


def relocate_frames(result: Calibration, dataset: Dataset) -> Calibration:
    """The result with the paths of its images and clouds taken from a dataset that has moved.

    Args:
        result: of ``calibrate``, or of a table whose frame numbers are those of the dataset.
        dataset: the same folders in the same order.

    Raises:
        DatasetError: if the dataset does not have the result's frames, or other images or clouds
            under their names.
    """
    available = {frame.index: frame for frame in dataset.frames}
    names = _frame_names(result)
    for number, name in names.items():
        if number not in available or name not in (None, available[number].name):
            raise DatasetError(
                f"{', '.join(map(str, dataset.folders))}: has no frame number {number}"
                f"{'' if name is None else f' named {name!r}'}, which the result was made from; "
                "give the same folders in the same order",
                frame=number,
            )
    for entry in result.frames:
        _require_same_files(result, entry, available[entry["frame"]])
    return replace(result, frames=tuple(available[number].entry() for number in names))


def _require_same_files(result: Calibration, entry: Mapping[str, Any], frame: Frame) -> None:
    """Check that a frame's cloud and images are those that the result was made from."""
    before = {"cloud": entry["cloud"], **entry["images"]}
    now = {"cloud": frame.cloud_path, **frame.image_paths}
    for what in before.keys() & now.keys():
        recorded = result.inputs.get(before[what])
        if recorded is not None and recorded != hash_source(now[what]):
            raise DatasetError(
                f"{now[what]}: is not what the result was made from ({before[what]}): it has "
                "another content; give the same recording",
                frame=frame.index,
            )


def _frame_names(result: Calibration) -> dict[int, str | None]:
    """The name of each frame number; None where only correspondences have the number."""
    if result.frames or result.correspondences is None:
        return {entry["frame"]: entry["name"] for entry in result.frames}
    return dict.fromkeys(np.unique(result.correspondences.frame).tolist())

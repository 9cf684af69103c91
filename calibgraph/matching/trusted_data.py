"""Recordings to learn from: their extrinsics are trusted."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calibgraph.errors import DatasetError, FileError, in_words
from calibgraph.io import kitti
from calibgraph.io.calibrations import load_calibration
from calibgraph.io.dataset import Dataset, load_dataset
from calibgraph.io.frame import Frame, frame_of_entry, hash_source
from calibgraph.io.rigs import load_rig
from calibgraph.model.result_files import CALIBRATION_FILE, is_calibration_file
from calibgraph.model.rig import Rig

REFERENCE_NAME = "reference.yaml"


def load_trusted_dataset(folder: Path, rig: Rig | None = None) -> Dataset:
    """Load a dataset with extrinsics to train on.

    Args:
        folder: a result of ``calibrate``, whose frames and PASS cameras are taken; a KITTI odometry
            sequence; or a dataset folder.
        rig: with the trusted extrinsics; if None, those of the result, the sequence's calib.txt or
            the folder's reference.yaml.

    Raises:
        DatasetError: if there is none of these: the folder's rig.yaml is only a guess; or if no
            camera of the result is PASS, or its files are missing, have changed, or have no hash.
    """
    result = folder / CALIBRATION_FILE if folder.is_dir() else folder
    if rig is None and is_calibration_file(result):
        return _of_result(folder)
    if rig is None and not (folder / kitti.CALIBRATION_NAME).is_file():
        reference = folder / REFERENCE_NAME
        if folder.is_dir() and not reference.is_file():
            raise DatasetError(
                f"{folder}: is no result of calibrate, and has no {REFERENCE_NAME} (a rig.yaml is "
                "a guess); give a result, or add the trusted rig as that file"
            )
        rig = load_rig(reference) if folder.is_dir() else None
    return load_dataset(folder, rig)


def _of_result(folder: Path) -> Dataset:
    result = load_calibration(folder)
    passed = {n: c for n, c in result.rig.cameras.items()
              if result.camera_verdicts[n].status == "PASS"}  # fmt: skip
    if not passed or not result.frames:
        what = "is of a table, without images" if passed else "has no camera that is PASS"
        raise DatasetError(f"{folder}: {what}; give a result of calibrate with a PASS")
    frames = tuple(frame_of_entry(entry) for entry in result.frames)
    for frame in frames:
        _require_same(frame, result.inputs, folder)
    sources = (path for each in frames for path in (each.cloud_path, *each.image_paths.values()))
    files = [path.absolute() for path in sources]
    return Dataset(Rig(cameras=passed), frames, (Path(os.path.commonpath(files)),))


def _require_same(frame: Frame, hashes: dict[str, str], folder: Path) -> None:
    for path in (frame.cloud_path, *frame.image_paths.values()):
        known = hashes.get(str(path))
        if known is None:
            what = f"{folder}: lists no hash of {path}, which may have changed"
        elif known != _hash(path, folder):
            what = f"{path}: has changed since it was calibrated"
        else:
            continue
        raise DatasetError(f"{what}; calibrate again", frame=frame.index)


def _hash(path: Path, folder: Path) -> str:
    try:
        return hash_source(path)
    except (OSError, FileError) as error:
        relative = "its paths are relative: start this in the folder where calibrate ran"
        advice = "put the recording back" if path.is_absolute() else relative
        raise DatasetError(
            f"{folder}: its file {path} cannot be read ({in_words(error)}); {advice}, or calibrate "
            "again"
        ) from error


def load_held_out(
    folders: Sequence[Path], learned: Sequence[Dataset], rig: Rig | None = None
) -> list[Dataset]:
    """Load recordings that only measure, as :func:`load_trusted_dataset`.

    Raises:
        DatasetError: if a frame of one is learned from.
    """
    clouds = {frame.cloud_path.resolve() for data in learned for frame in data.frames}
    found = [load_trusted_dataset(folder, rig) for folder in folders]
    for folder, data in zip(folders, found, strict=True):
        if not clouds.isdisjoint(frame.cloud_path.resolve() for frame in data.frames):
            raise DatasetError(
                f"{folder}: is learned from and held out; hold out another recording"
            )
    return found


def split(datasets: Sequence[Dataset]) -> tuple[list[Dataset], list[Dataset]]:
    """Split each dataset's frames into the first four fifths and the last; neighbours look alike.

    Raises:
        DatasetError: if one has a single frame.
    """
    for dataset in datasets:
        if len(dataset.frames) < 2:  # noqa: PLR2004
            raise DatasetError(
                f"{dataset.folders[0]}: one frame cannot be split; name others with --held-out"
            )
    cuts = [min(len(d.frames) - 1, -(-4 * len(d.frames) // 5)) for d in datasets]
    return (
        [replace(d, frames=d.frames[:cut]) for d, cut in zip(datasets, cuts, strict=True)],
        [replace(d, frames=d.frames[cut:]) for d, cut in zip(datasets, cuts, strict=True)],
    )

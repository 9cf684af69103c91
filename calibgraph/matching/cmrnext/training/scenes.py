"""Scenes to learn from: images and clouds of frames whose extrinsics are trusted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from calibgraph.errors import DatasetError
from calibgraph.io import kitti
from calibgraph.io.dataset import Dataset, load_dataset
from calibgraph.io.frame import Frame
from calibgraph.io.rigs import load_rig
from calibgraph.model.rig import Camera, Rig

REFERENCE_NAME = "reference.yaml"


@dataclass(frozen=True)
class Scene:
    """One camera's image and the cloud of one frame."""

    frame: Frame
    name: str
    camera: Camera


def load_trusted_dataset(folder: Path, rig: Rig | None = None) -> Dataset:
    """Load a dataset with extrinsics to train on.

    Args:
        folder: a KITTI odometry sequence, or a dataset folder.
        rig: with the trusted extrinsics; if None, the sequence's calib.txt or the folder's
            reference.yaml.

    Raises:
        DatasetError: if the folder has neither: its rig.yaml is only a guess.
    """
    if rig is None and not (folder / kitti.CALIBRATION_NAME).is_file():
        reference = folder / REFERENCE_NAME
        if folder.is_dir() and not reference.is_file():
            raise DatasetError(
                f"{folder}: has no {REFERENCE_NAME}, and its rig.yaml is a guess; give the trusted "
                "extrinsic with --rig"
            )
        rig = load_rig(reference) if folder.is_dir() else None
    return load_dataset(folder, rig)


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


def list_scenes(datasets: Sequence[Dataset]) -> list[Scene]:
    """Every camera of every frame."""
    return [
        Scene(frame, name, camera)
        for dataset in datasets
        for frame in dataset.frames
        for name, camera in dataset.rig.cameras.items()
    ]


def require_disjoint(scenes: Sequence[Scene], held_out: Sequence[Scene]) -> None:
    """Check that no frame is both trained on and held out.

    Raises:
        DatasetError: naming one that is.
    """
    one, two = ({s.frame.cloud_path.resolve() for s in some} for some in (scenes, held_out))
    if both := one & two:
        raise DatasetError(
            f"{min(both)} is among the frames to train on and among those held out; hold out others"
        )

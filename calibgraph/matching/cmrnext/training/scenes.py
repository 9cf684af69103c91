"""Scenes to learn from: images and clouds of frames whose extrinsics are trusted."""

from collections.abc import Sequence
from dataclasses import dataclass

from calibgraph.errors import DatasetError
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.model.rig import Camera


@dataclass(frozen=True)
class Scene:
    """One camera's image and the cloud of one frame."""

    frame: Frame
    name: str
    camera: Camera


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

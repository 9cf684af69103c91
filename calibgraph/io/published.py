"""Folders of published data sets that hold their own rig; each format is one entry here."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from calibgraph.io import argoverse, kitti_object, kitti_raw, nuscenes
from calibgraph.io.frame_files import FrameFiles
from calibgraph.io.incomplete import RigRead


@dataclass(frozen=True)
class PublishedFormat:
    """How a data set is read; ``describe`` gives a line for the log, or an empty text."""

    is_one: Callable[[Path], bool]
    read_rig: Callable[[Path], RigRead]
    frames: Callable[[Path, Sequence[str]], list[FrameFiles]]
    describe: Callable[[Path], str] = lambda _: ""


_FORMATS = (
    PublishedFormat(
        nuscenes.is_nuscenes, nuscenes.read_nuscenes_rig, nuscenes.nuscenes_frames,
        nuscenes.describe_motion,
    ),
    PublishedFormat(
        kitti_raw.is_kitti_raw, kitti_raw.read_kitti_raw_rig, kitti_raw.kitti_raw_frames
    ),
    PublishedFormat(
        kitti_object.is_kitti_object, kitti_object.read_kitti_object_rig,
        kitti_object.kitti_object_frames, kitti_object.describe_calibrations,
    ),
    PublishedFormat(
        argoverse.is_argoverse, argoverse.read_argoverse_rig, argoverse.argoverse_frames,
        argoverse.describe_motion,
    ),
)  # fmt: skip


def published_format(path: Path | str) -> PublishedFormat | None:
    """The format of a folder of a published data set, or of its scene; None of others."""
    return next((each for each in _FORMATS if each.is_one(Path(path))), None)

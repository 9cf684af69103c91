"""Dataset folders: the cloud and the images of every frame, by the format of the folder.

A further format of folders adds a :class:`FolderLayout` to :func:`folder_layout`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from calibgraph.errors import DatasetError, FileError
from calibgraph.io import kitti
from calibgraph.io.clouds import CLOUD_SUFFIXES
from calibgraph.io.images import IMAGE_SUFFIXES


@dataclass(frozen=True)
class FolderLayout:
    """Where a dataset folder keeps its files; those of one frame have the same stem.

    Attributes:
        clouds: the folder of the clouds.
        images: per camera, the folder of its images.
    """

    clouds: Path
    images: Mapping[str, Path]


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame.

    Attributes:
        stem: their common stem.
        cloud: the cloud's file.
        images: per camera, the image's file.
    """

    stem: str
    cloud: Path
    images: dict[str, Path]


def folder_layout(folder: Path) -> FolderLayout:
    """The layout of a KITTI odometry sequence, or of a dataset folder."""
    if (folder / kitti.CALIBRATION_NAME).is_file():
        return FolderLayout(folder / kitti.CLOUD_FOLDER, kitti.camera_folders(folder))
    cameras = {path.name: path for path in sorted((folder / "cameras").glob("*/"))}
    return FolderLayout(folder / "lidar", cameras)


def frames_of_folder(folder: Path, cameras: Sequence[str]) -> list[FrameFiles]:
    """The frames of a folder, sorted by stem.

    Args:
        folder: a dataset folder or a KITTI odometry sequence.
        cameras: the cameras of which every frame has an image.

    Raises:
        FileError, DatasetError: if a folder is missing or empty, or frames do not pair up.
    """
    layout = folder_layout(folder)
    clouds = _files(layout.clouds, CLOUD_SUFFIXES)
    images = {}
    for name in cameras:
        if name not in layout.images:
            raise FileError(
                folder,
                f"has no images of the rig's camera {name!r}; it has "
                f"{', '.join(layout.images) or 'none'}",
            )
        images[name] = _files(layout.images[name], IMAGE_SUFFIXES)
        _require_pairs(folder, name, set(clouds), set(images[name]))
    return [
        FrameFiles(stem, cloud, {name: images[name][stem] for name in cameras})
        for stem, cloud in clouds.items()
    ]


def _files(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """Files of a folder with one of the suffixes, by stem, in order."""
    if not folder.is_dir():
        raise FileError(folder, "no such folder")
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in suffixes and not path.name.startswith("."):
            if path.stem in files:
                raise FileError(path, f"and {files[path.stem].name} are the same frame; keep one")
            files[path.stem] = path
    if not files:
        raise FileError(folder, f"holds no file of a known kind ({', '.join(suffixes)})")
    return files


def _require_pairs(folder: Path, camera: str, clouds: set[str], images: set[str]) -> None:
    """Check that every cloud has an image of the camera, and every image a cloud."""
    lonely = sorted(clouds ^ images)
    if lonely:
        image = f"of camera {camera!r}"
        what = f"a cloud but no image {image}"
        if lonely[0] not in clouds:
            what = f"an image {image} but no cloud"
        raise DatasetError(
            f"{folder}: frame {lonely[0]!r} has {what} "
            f"({len(lonely)} such frames); give both the same name, or remove the lonely file",
            camera=camera,
            frame=lonely[0],
        )

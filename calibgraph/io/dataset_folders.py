"""Dataset folders: the cloud and the images of every frame, by the format of the folder.

A further format of folders adds a :class:`FolderLayout` to :func:`folder_layout`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from calibgraph.errors import DatasetError, FileError
from calibgraph.files import is_utf8
from calibgraph.io import kitti
from calibgraph.io.clouds import CLOUD_SUFFIXES
from calibgraph.io.images import IMAGE_SUFFIXES
from calibgraph.io.kitti_raw import is_kitti_raw, kitti_raw_folders
from calibgraph.io.nuscenes import is_nuscenes, nuscenes_frames


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
        images: per camera that has one, the image's file.
    """

    stem: str
    cloud: Path
    images: dict[str, Path]


def folder_layout(folder: Path) -> FolderLayout:
    """The layout of a KITTI odometry sequence or raw drive, or of a dataset folder."""
    if (folder / kitti.CALIBRATION_NAME).is_file():
        return FolderLayout(folder / kitti.CLOUD_FOLDER, kitti.camera_folders(folder))
    if is_kitti_raw(folder):
        return FolderLayout(*kitti_raw_folders(folder))
    cameras = {path.name: path for path in sorted((folder / "cameras").glob("*/"))}
    return FolderLayout(folder / "lidar", cameras)


def frames_of_folder(
    folder: Path, cameras: Sequence[str], *, complete: bool = True
) -> list[FrameFiles]:
    """The frames of a folder, one per cloud, sorted by stem.

    Args:
        folder: a dataset folder, a KITTI odometry sequence, or a nuScenes folder or scene.
        cameras: the rig's.
        complete: whether every cloud must have an image of every camera, and every image a cloud.

    Raises:
        FileError, DatasetError: if a folder is missing or empty, or frames do not pair up.
    """
    if is_nuscenes(folder):
        return _frames_of_nuscenes(folder, cameras, complete=complete)
    layout = folder_layout(folder)
    clouds = _files(layout.clouds, CLOUD_SUFFIXES)
    images = {name: _files(_image_folder(folder, layout, name), IMAGE_SUFFIXES) for name in cameras}
    for name in cameras if complete else ():
        _require_pairs(folder, name, set(clouds), set(images[name]))
    return [
        FrameFiles(stem, cloud, {n: images[n][stem] for n in cameras if stem in images[n]})
        for stem, cloud in clouds.items()
    ]


def _frames_of_nuscenes(
    folder: Path, cameras: Sequence[str], *, complete: bool
) -> list[FrameFiles]:
    """The samples; complete ones have an image of every camera."""
    found = [
        FrameFiles(stem, cloud, {name: images[name] for name in cameras if name in images})
        for stem, cloud, images in nuscenes_frames(folder)
    ]
    for name in cameras if complete else ():
        stems = ({f.stem for f in found}, {f.stem for f in found if name in f.images})
        _require_pairs(folder, name, *stems)
    return found


def _image_folder(folder: Path, layout: FolderLayout, camera: str) -> Path:
    """The folder of a camera's images.

    Raises:
        FileError: if there is none.
    """
    if camera not in layout.images:
        raise FileError(
            folder,
            f"has no images of the rig's camera {camera!r}; it has "
            f"{', '.join(layout.images) or 'none'}: give the folder cameras/NAME and the camera "
            "in rig.yaml the same name, or remove the camera from rig.yaml",
        )
    return layout.images[camera]


def _files(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """Files of a folder with one of the suffixes, by stem, in order."""
    kinds = ", ".join(suffixes)
    if not folder.is_dir():
        beside = ", ".join(sorted(path.name for path in folder.parent.glob("*/"))) or "none"
        raise FileError(
            folder, f"no such folder; put the files ({kinds}) there, found are the folders {beside}"
        )
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in suffixes and not path.name.startswith("."):
            if path.stem in files:
                raise FileError(path, f"and {files[path.stem].name} are the same frame; keep one")
            if not is_utf8(path.name):
                raise FileError(path, "its name is not UTF-8; rename it")
            files[path.stem] = path
    if not files:
        raise FileError(folder, f"holds no file of a known kind; write or convert to {kinds}")
    return files


def _require_pairs(folder: Path, camera: str, clouds: set[str], images: set[str]) -> None:
    """Check that every cloud has an image of the camera, and every image a cloud."""
    lonely = sorted(clouds ^ images)
    if not lonely:
        return
    image = f"of camera {camera!r}"
    what = f"a cloud but no image {image}"
    if lonely[0] not in clouds:
        what = f"an image {image} but no cloud"
    others = f", and {len(lonely) - 1} more do not pair up" if lonely[1:] else ""
    raise DatasetError(
        f"{folder}: frame {lonely[0]!r} has {what}{others}; give both the same name, remove the "
        "lonely file, or choose complete frames (--frames)",
        camera=camera,
        frame=lonely[0],
    )

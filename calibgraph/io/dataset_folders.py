"""Dataset folders: the cloud and the images of every frame, by the format of the folder.

Folders of published data sets hold their own rig; each of their formats is one entry here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from calibgraph.errors import DatasetError, FileError
from calibgraph.io import argoverse, kitti, kitti_drives, nuscenes
from calibgraph.io.clouds import CLOUD_SUFFIXES
from calibgraph.io.frame_files import FrameFiles, RigRead, files_by_stem, frames_by_stem
from calibgraph.io.images import IMAGE_SUFFIXES
from calibgraph.io.videos import VIDEO_SUFFIXES, pictures_of_video


@dataclass(frozen=True)
class FolderLayout:
    """Where a dataset folder keeps its files; the files of one frame have the same stem."""

    clouds: Path
    images: Mapping[str, Path]


def folder_layout(folder: Path) -> FolderLayout:
    """The layout of a KITTI odometry sequence, or of a dataset folder.

    Raises:
        FileError: if a camera has a folder of images and a video, or two videos.
    """
    if (folder / kitti.CALIBRATION_NAME).is_file():
        return FolderLayout(folder / kitti.CLOUD_FOLDER, kitti.camera_folders(folder))
    cameras: dict[str, Path] = {}
    for path in sorted((folder / "cameras").glob("*")):
        is_video = path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()
        name = path.stem if is_video else path.name
        if (is_video or path.is_dir()) and name in cameras:
            raise FileError(path, f"and {cameras[name].name} are the same camera; keep one")
        if is_video or path.is_dir():
            cameras[name] = path
    return FolderLayout(folder / "lidar", cameras)


def frames_of_folder(
    folder: Path, cameras: Sequence[str], *, complete: bool = True
) -> list[FrameFiles]:
    """The frames of a folder, one per cloud, sorted by stem.

    Args:
        folder: a dataset folder, a KITTI odometry sequence, or one of a published data set.
        cameras: the rig's.
        complete: whether every cloud must have an image of every camera, and every image a cloud.
    """
    published = published_format(folder)
    if published is not None:
        frames = published.frames(folder, cameras)
        for name in cameras if complete else ():
            stems = ({f.stem for f in frames}, {f.stem for f in frames if name in f.images})
            _require_pairs(folder, name, *stems)
        return frames
    layout = folder_layout(folder)
    clouds = files_by_stem(layout.clouds, CLOUD_SUFFIXES)
    images = {name: _images(_image_folder(folder, layout, name), list(clouds)) for name in cameras}
    for name in cameras if complete else ():
        _require_pairs(folder, name, set(clouds), set(images[name]))
    return frames_by_stem(clouds, images)


def _images(source: Path, clouds: Sequence[str]) -> dict[str, Path]:
    """The images of a camera by stem: files of a folder, or pictures of a video with a cloud."""
    if source.is_file():
        return pictures_of_video(source, clouds)
    return files_by_stem(source, IMAGE_SUFFIXES)


def _image_folder(folder: Path, layout: FolderLayout, camera: str) -> Path:
    """The folder of a camera's images."""
    if camera not in layout.images:
        raise FileError(
            folder,
            f"has no images of the rig's camera {camera!r}; it has "
            f"{', '.join(layout.images) or 'none'}: give the folder cameras/NAME and the camera "
            "in rig.yaml the same name, or remove the camera from rig.yaml",
        )
    return layout.images[camera]


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
        kitti_drives.is_kitti_raw, kitti_drives.read_kitti_raw_rig, kitti_drives.kitti_raw_frames
    ),
    PublishedFormat(
        kitti_drives.is_kitti_object, kitti_drives.read_kitti_object_rig,
        kitti_drives.kitti_object_frames, kitti_drives.describe_calibrations,
    ),
    PublishedFormat(
        argoverse.is_argoverse, argoverse.read_argoverse_rig, argoverse.argoverse_frames,
        argoverse.describe_motion,
    ),
)  # fmt: skip


def published_format(path: Path | str) -> PublishedFormat | None:
    """The format of a folder of a published data set, or of its scene; None of others."""
    return next((each for each in _FORMATS if each.is_one(Path(path))), None)

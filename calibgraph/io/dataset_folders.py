"""Dataset folders: the cloud and the images of every frame, by the format of the folder.

Folders of published data sets hold their own rig; each of their formats is one entry here.
"""

import glob
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from calibgraph.errors import DatasetError, FileError
from calibgraph.io import kitti
from calibgraph.io.argoverse import argoverse
from calibgraph.io.bags.stamps import (
    TopicStamps,
    after_ns,
    describe_offsets,
    describe_spans,
    nearest,
    offsets_of,
)
from calibgraph.io.bags.storage import NEAR_S
from calibgraph.io.clouds import CLOUD_SUFFIXES
from calibgraph.io.frame import Frame, frames_by_stem
from calibgraph.io.frame_files import files_by_stem, stamp_ns_in_name, way_out
from calibgraph.io.images import IMAGE_SUFFIXES
from calibgraph.io.nuscenes import nuscenes
from calibgraph.io.published import PublishedFolder

LIDARS = "lidars"
"""Folder of the folders of several LiDARs, named as in the rig."""


def folder_layout(folder: Path, lidar: str = "") -> tuple[Path, dict[str, Path]]:
    """The folders of clouds and of each camera's images; files of one frame have the same stem.

    Of a KITTI odometry sequence, or of a dataset folder; of one with several LiDARs ``lidar`` is
    the base.
    """
    if (folder / kitti.CALIBRATION_NAME).is_file():
        return folder / kitti.CLOUD_FOLDER, kitti.camera_folders(folder)
    cameras = sorted(path for path in (folder / "cameras").glob("*") if path.is_dir())
    clouds = folder / LIDARS / lidar if (folder / LIDARS).is_dir() else folder / "lidar"
    return clouds, {path.name: path for path in cameras}


def frames_of_folder(
    folder: Path, cameras: Sequence[str], *, lidars: Sequence[str] = (), complete: bool = True,
    sync_tolerance_s: float = NEAR_S,
) -> tuple[list[Frame], str]:  # fmt: skip
    """The frames of a folder; where names are stamps, those with an image near enough.

    Args:
        folder: a dataset folder, a KITTI odometry sequence, or one of a published data set.
        cameras: the rig's.
        lidars: the rig's if there are several, the base first; a frame has the clouds that have its
            stem.
        complete: whether every cloud must have an image of every camera, and every image a cloud,
            where names are no stamps.
        sync_tolerance_s: largest difference of the stamps that name a cloud and its images.

    Returns:
        The frames, one per cloud, in the order of the numbers in their names; and how
        images were paired with clouds by stamps, in a line, empty where both have the same names.
    """
    published = published_folder(folder)
    if published is not None:
        frames = published.frames(cameras)
        for name in cameras if complete else ():
            stems = ({f.name for f in frames}, {f.name for f in frames if name in f.image_paths})
            _require_pairs(folder, name, *stems)
        return frames, ""
    of_clouds, of_images = folder_layout(folder, *lidars[:1])
    clouds = files_by_stem(of_clouds, CLOUD_SUFFIXES)
    others = {name: files_by_stem(folder / LIDARS / name, CLOUD_SUFFIXES) for name in lidars[1:]}
    images = {
        name: _of_same_number(
            clouds, files_by_stem(_image_folder(folder, of_images, name), IMAGE_SUFFIXES)
        )
        for name in cameras
    }
    stamped = _stamps(clouds)
    if stamped and any(found.keys() != clouds.keys() for found in images.values()):
        taken = {name: s for name, found in images.items() if (s := _stamps(found))}
        if taken.keys() == images.keys():
            return _paired_by_stamps(folder, stamped, taken, sync_tolerance_s=sync_tolerance_s)
    for name in cameras if complete else ():
        _require_pairs(folder, name, set(clouds), set(images[name]))
    return frames_by_stem(clouds, images, others), ""


def _of_same_number(clouds: Mapping[str, Path], images: Mapping[str, Path]) -> dict[str, Path]:
    """Images by the stems of their clouds: 8, 000008 and image_8 are one frame.

    Names are told apart by their last number; where one number stands twice, they stay as they are.
    """
    by_number = _by_last_number(clouds)
    numbers = _by_last_number(images)
    if by_number.keys() & numbers.keys() and not clouds.keys() & images.keys():
        return {by_number.get(number, stem): images[stem] for number, stem in numbers.items()}
    return dict(images)


def _by_last_number(stems: Iterable[str]) -> dict[int, str]:
    """Stems by the last number in them; none if a stem has none, or two have the same."""
    found = {int(words[-1]): s for s in stems if (words := re.findall(r"[0-9]+", s))}
    return found if len(found) == len([*stems]) else {}


def _stamps(files: Mapping[str, Path]) -> TopicStamps | None:
    """The stamps that name files; None if a name states none, or two the same."""
    stamps = [stamp_ns_in_name(stem) for stem in files]
    found = [stamp for stamp in stamps if stamp is not None]
    if len(set(found)) < len(stamps):
        return None
    in_order = sorted(zip(found, files.values(), strict=True))
    stamp_ns = [stamp for stamp, _ in in_order]
    return TopicStamps([path for _, path in in_order], stamp_ns, stamp_ns)


def _paired_by_stamps(
    folder: Path, clouds: TopicStamps, images: Mapping[str, TopicStamps], *, sync_tolerance_s: float
) -> tuple[list[Frame], str]:
    """Each cloud with the image of every camera that is nearest by its name, as in a bag."""
    frames = [Frame(n, path.stem, path, {}) for n, path in enumerate(clouds.paths)]
    parts = []
    for name, found in images.items():
        rows = nearest(clouds, found, round(sync_tolerance_s * 1e9))
        paired = np.flatnonzero(rows >= 0)
        if not len(paired):
            apart_ns = offsets_of(clouds, found)
            said = (
                describe_offsets(name, apart_ns) if len(apart_ns)
                else describe_spans({"clouds are from": clouds, "images from": found})
            )  # fmt: skip
            raise DatasetError(
                f"{folder}: no cloud has an image of {name} within {sync_tolerance_s:g} s by the "
                f"stamps in their names: {said}; give a larger sync_tolerance_s in --config, or "
                "name the files by one clock",
                camera=name,
            )
        for cloud in paired:
            frames[cloud].image_paths[name] = found.paths[rows[cloud]]
        apart_ns = after_ns(clouds, found, rows, paired)
        unused = len(found.paths) - len({*rows[paired]})
        unused_text = f" ({unused} images not used)" if unused else ""
        parts.append(describe_offsets(name, apart_ns) + unused_text)
    complete = sum(len(frame.image_paths) == len(images) for frame in frames)
    pairing = (
        f"{folder}: files are paired by the stamps in their names: {complete} of {len(frames)} "
        f"clouds have all images within {sync_tolerance_s:g} s (sync_tolerance_s); "
        + "; ".join(parts)
    )
    if not complete:
        raise DatasetError(f"{pairing}; calibrate the cameras apart")
    return frames, pairing


def describe_pairing(folder: Path) -> str:
    """How the files of a folder pair by stamps, or which do not pair; empty if all names agree."""
    try:
        return frames_of_folder(folder, [*folder_layout(folder)[1]])[1]
    except DatasetError as error:
        return str(error)


def _image_folder(folder: Path, images: Mapping[str, Path], camera: str) -> Path:
    if camera not in images:
        for path in (folder / "cameras").glob(f"{glob.escape(camera)}.*"):
            if remedy := way_out(path):
                raise FileError(path, remedy)
        raise FileError(
            folder,
            f"has no images of the rig's camera {camera!r}; it has "
            f"{', '.join(images) or 'none'}: give the folder cameras/NAME and the camera "
            "in rig.yaml the same name, or remove the camera from rig.yaml",
        )
    return images[camera]


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


_PUBLISHED = (nuscenes, kitti.kitti_drive, argoverse)


def published_folder(path: Path | str) -> PublishedFolder | None:
    """A folder of a published data set with a rig of its own, or its scene; None of others."""
    found = (read(Path(path)) for read in _PUBLISHED)
    return next((each for each in found if each is not None), None)

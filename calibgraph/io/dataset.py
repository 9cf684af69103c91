"""Datasets: which images and clouds belong together. Nothing is decoded until it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import DatasetError, FileError
from calibgraph.io import kitti
from calibgraph.io.clouds import CLOUD_SUFFIXES, load_cloud
from calibgraph.io.rigs import load_rig
from calibgraph.model.rig import Camera, Rig

Item = TypeVar("Item")

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Frame:
    """One cloud and the images taken with it.

    Attributes:
        index: number of the frame in its dataset, the ``frame`` of its correspondences.
        name: what to call it: the files' stem, after the sequence's name if there are several.
        cloud_path: the cloud's file.
        image_paths: the image's file, per camera that has one.
    """

    index: int
    name: str
    cloud_path: Path
    image_paths: dict[str, Path]

    def load_cloud(self) -> NDArray[np.float32]:
        """(n, 4) x y z [m], intensity; see :func:`calibgraph.clouds.load_cloud`."""
        return load_cloud(self.cloud_path)

    def load_image(self, name: str, camera: Camera) -> NDArray[np.uint8]:
        """(height, width, 3) image, BGR; see :func:`load_image`."""
        return load_image(self.image_paths[name], camera)

    def load_gray(self, name: str, camera: Camera) -> NDArray[np.uint8]:
        """(height, width) the same image, gray."""
        gray = cv2.cvtColor(self.load_image(name, camera), cv2.COLOR_BGR2GRAY)
        return np.asarray(gray, dtype=np.uint8)

    def entry(self) -> dict[str, Any]:
        """Which files the frame's number stands for, as a result keeps it."""
        return {
            "frame": self.index,
            "name": self.name,
            "cloud": str(self.cloud_path),
            "images": {name: str(path) for name, path in self.image_paths.items()},
        }


@dataclass(frozen=True)
class Dataset:
    """Frames of one rig.

    Attributes:
        rig: the rig that lies with the data: its poses are a guess, or (KITTI) the reference.
        frames: in order of time.
        folders: where they come from.
        recorded: all frames of the folders, where only some of them were selected.
    """

    rig: Rig
    frames: tuple[Frame, ...]
    folders: tuple[Path, ...]
    recorded: tuple[Frame, ...] = ()

    def neighbour(self, frame: Frame, later: int) -> Frame | None:
        """The frame recorded so many frames later in the same folder, selected or not."""
        other = self._by_index.get(frame.index + later)
        same = other is not None and other.cloud_path.parent == frame.cloud_path.parent
        return other if same else None

    @cached_property
    def _by_index(self) -> dict[int, Frame]:
        return {frame.index: frame for frame in (*self.recorded, *self.frames)}

    def spread_out(self, most: int) -> Dataset:
        """At most so many of the frames, evenly spread over them."""
        return self._only(spread_out(self.frames, most))

    def select(self, frames: str) -> Dataset:
        """Keep some frames, by their position among the frames sorted by name, from 0.

        Args:
            frames: ``start:stop:step`` as in Python, or positions separated by commas.

        Raises:
            ValueError: if the text is neither, or selects nothing.
        """
        try:
            kept = [self.frames[i] for i in _indices(frames, len(self.frames))]
        except (ValueError, IndexError, TypeError) as error:
            raise ValueError(
                f"frames {frames!r}: expected start:stop:step or positions separated by commas, "
                f"counted from 0 in the {len(self.frames)} frames sorted by name"
            ) from error
        if not kept:
            raise ValueError(f"frames {frames!r} selects none of the {len(self.frames)} frames")
        return self._only(kept)

    def _only(self, frames: Sequence[Frame]) -> Dataset:
        return replace(self, frames=tuple(frames), recorded=self.recorded or self.frames)


def load_dataset(folders: Path | str | Sequence[Path | str], rig: Rig | None = None) -> Dataset:
    """Find the frames of a dataset folder, a KITTI odometry sequence, or several of one rig.

    Args:
        folders: one folder or several; several form one calibration problem.
        rig: used instead of the rig that lies in the folder.

    Raises:
        FileError, DatasetError: if a folder is missing, frames do not pair up, or the folders'
            rigs differ.
    """
    if isinstance(folders, (str, Path)):
        folders = [folders]
    paths = tuple(Path(folder) for folder in folders)
    if not paths:
        raise ValueError("no dataset folder given")
    rigs = [rig if rig is not None else load_rig(path) for path in paths if _require_folder(path)]
    for path, other in zip(paths, rigs, strict=True):
        _require_same_lenses(paths[0], rigs[0], path, other)
    frames = [frame for path in paths for frame in _frames(path, rigs[0])]
    prefix = [f"{path.name}/" if len(paths) > 1 else "" for path in paths for _ in _stems(path)]
    named = (replace(frame, index=i, name=prefix[i] + frame.name) for i, frame in enumerate(frames))
    return Dataset(rig=rigs[0], frames=tuple(named), folders=paths)


def spread_out(items: Sequence[Item], most: int) -> list[Item]:
    """At most so many of the items, evenly spread over them: neighbours look alike."""
    places = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return [items[place] for place in places]


def load_image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Decode an image and check its size against the rig's.

    Returns:
        (height, width, 3) uint8, BGR.

    Raises:
        FileError: if it is missing, truncated, or not of the size that the rig says.
    """
    data = path.read_bytes() if path.is_file() else None
    if data is None:
        raise FileError(path, "no such image")
    if not _ends_properly(data, path.suffix.lower()):
        raise FileError(path, "is truncated or not an image of its kind; record or copy it again")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise FileError(path, "cannot be decoded as an image; is it complete?")
    found, expected = (image.shape[1], image.shape[0]), (camera.width_px, camera.height_px)
    if found != expected:
        raise FileError(
            path,
            f"is {found[0]}x{found[1]} px, the rig says {expected[0]}x{expected[1]} px; correct "
            "width_px and height_px, and the intrinsics if the image was scaled",
        )
    if not image.any() and np.any(cv2.imdecode(np.frombuffer(data, np.uint8), _AS_IT_IS)):
        raise FileError(path, "has 16 bits, of which only the lower 8 are used; write it with 8")
    return np.asarray(image, dtype=np.uint8)


_AS_IT_IS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH


def _ends_properly(data: bytes, suffix: str) -> bool:
    """Whether the format's end mark is there: OpenCV decodes half a file without complaint."""
    if suffix == ".png":
        return data[-12:-8] == b"\0\0\0\0" and data[-8:-4] == b"IEND"
    return b"\xff\xd9" in data[-64:]


def _indices(text: str, count: int) -> list[int]:
    if ":" not in text:
        return [range(count)[int(part)] for part in text.split(",")]
    parts = [int(part) if part.strip() else None for part in text.split(":")]
    return list(range(count))[slice(*parts)]


def _require_folder(path: Path) -> bool:
    if not path.is_dir():
        raise FileError(path, "no such folder; expected a dataset or a KITTI sequence")
    return True


def _require_same_lenses(first: Path, rig: Rig, path: Path, other: Rig) -> None:
    lenses = [
        {name: camera.model_dump(exclude={"T_camera_lidar"}) for name, camera in r.cameras.items()}
        for r in (rig, other)
    ]
    if lenses[0] != lenses[1]:
        raise DatasetError(
            f"{path}: its cameras differ from those of {first} (names, sizes or intrinsics); "
            "calibrate different rigs apart"
        )


def _is_kitti(folder: Path) -> bool:
    return (folder / kitti.CALIBRATION_NAME).is_file()


def _cloud_folder(folder: Path) -> Path:
    return folder / (kitti.CLOUD_FOLDER if _is_kitti(folder) else "lidar")


def _stems(folder: Path) -> dict[str, Path]:
    return _files(_cloud_folder(folder), CLOUD_SUFFIXES)


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


def _frames(folder: Path, rig: Rig) -> list[Frame]:
    clouds = _stems(folder)
    if _is_kitti(folder):
        image_folders = kitti.camera_folders(folder)
    else:
        image_folders = {path.name: path for path in sorted((folder / "cameras").glob("*/"))}
    images = {}
    for name in rig.cameras:
        if name not in image_folders:
            raise FileError(
                folder,
                f"has no images of the rig's camera {name!r}; it has "
                f"{', '.join(image_folders) or 'none'}",
            )
        images[name] = _files(image_folders[name], IMAGE_SUFFIXES)
        _require_pairs(folder, name, set(clouds), set(images[name]))
    return [
        Frame(index, stem, cloud, {name: images[name][stem] for name in rig.cameras})
        for index, (stem, cloud) in enumerate(clouds.items())
    ]


def _require_pairs(folder: Path, camera: str, clouds: set[str], images: set[str]) -> None:
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

"""Datasets of arrays: images and clouds of a program that has them in memory, without files."""

import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibgraph.errors import DatasetError, FileError
from calibgraph.io.clouds import (
    check_points,
    cloud_of_array,
    describe_cloud,
    with_intensity,
)
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.io.point_fields import RawCloud
from calibgraph.model.rig import Camera, Rig

_COLOURS = (3, 4)  # channels


def dataset_from_arrays(
    rig: Rig,
    clouds: Sequence[ArrayLike],
    images: Mapping[str, Sequence[ArrayLike]],
    *,
    twists_per_s: ArrayLike | None = None,
) -> Dataset:
    """A dataset of arrays, to be calibrated without files. Images are not copied if they fit.

    Args:
        rig: lenses and the guess.
        clouds: per frame (n, 3) x y z or (n, 4) x y z intensity [m] in the LiDAR frame, or an array
            with such named fields; finite but for rows of NaN or zeros without a return.
        images: per camera and frame, (height, width, 3) BGR or (height, width) gray, uint8.
        twists_per_s: per frame, (6,) rotation [rad/s] and translation [m/s] of the LiDAR along its
            axes, if it moves and a time offset or read-out is to be estimated or known.

    Raises:
        DatasetError: if cameras, frames, shapes or values do not fit together.
    """
    if not isinstance(images, Mapping) or images.keys() != rig.cameras.keys():
        given = ", ".join(map(str, images)) if isinstance(images, Mapping) else "no camera by name"
        raise DatasetError(
            f"images are of {given or 'no camera'}, the rig has {', '.join(rig.cameras)}"
        )
    frames = _count(clouds, "clouds")
    for name, of_camera in images.items():
        if (count := _count(of_camera, f"images[{name!r}]")) != frames:
            raise DatasetError(
                f"{frames} clouds, but {count} images of {name}; give one each per frame",
                camera=name,
            )
    if not frames:
        raise DatasetError("no frame given")
    twists = None if twists_per_s is None else np.array(twists_per_s, dtype=np.float64)
    if twists is not None and not (twists.shape == (frames, 6) and np.isfinite(twists).all()):
        raise DatasetError(f"twists_per_s: expected ({frames}, 6) finite numbers, one row a frame")
    root = Path("arrays") / uuid.uuid4().hex[:8]  # caches tell frames apart by their paths
    first = _cloud(clouds[0], 0)
    return Dataset(
        rig=rig,
        frames=tuple(
            _frame(root, number, rig, clouds=clouds, images=images, twists=twists)
            for number in range(frames)
        ),
        folders=(root,),
        notes=tuple(describe_cloud("clouds[0]", first)),
    )


def _count(values: Sequence[ArrayLike], name: str) -> int:
    """The number of frames in a list of arrays."""
    if isinstance(values, np.ndarray) and values.ndim == 2:  # noqa: PLR2004
        found = f"one array of shape {values.shape}"
    elif hasattr(values, "__len__") and hasattr(values, "__getitem__"):
        return len(values)
    else:
        found = f"of type {type(values).__name__}"
    raise DatasetError(f"{name} is {found}, expected a list with an array per frame")


def _frame(
    root: Path,
    number: int,
    rig: Rig,
    *,
    clouds: Sequence[ArrayLike],
    images: Mapping[str, Sequence[ArrayLike]],
    twists: NDArray[np.float64] | None,
) -> Frame:
    name = f"{number:06d}"
    cloud_path, paths = root / "lidar" / name, {camera: root / camera / name for camera in images}
    arrays: dict[Path, NDArray[Any]] = {
        cloud_path: with_intensity(_cloud(clouds[number], number).points)
    }
    arrays |= {
        paths[camera]: _image(images[camera][number], lens, camera, number)
        for camera, lens in rig.cameras.items()
    }
    twist = None if twists is None else twists[number]
    return Frame(number, name, cloud_path, paths, twist=twist, arrays=arrays)


def _cloud(cloud: ArrayLike, number: int) -> RawCloud:
    """The points that are returns."""
    name = f"clouds[{number}]"
    try:
        found = cloud_of_array(_array(cloud, name), name)
        return found._replace(points=check_points(found.points, name))
    except FileError as error:
        raise DatasetError(str(error), frame=number) from None


def _array(values: ArrayLike, name: str) -> NDArray[Any]:
    """Values as an array; lists, too."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError) as error:
        raise DatasetError(f"{name}: {error}; give an array") from None


def _image(image: ArrayLike, camera: Camera, name: str, number: int) -> NDArray[np.uint8]:
    where = f"images[{name!r}][{number}]"
    pixels = _array(image, where)
    gray = pixels.ndim == 2  # noqa: PLR2004
    shape = (camera.height_px, camera.width_px)
    known = gray or (pixels.ndim == len(_COLOURS) + 1 and pixels.shape[2] in _COLOURS)
    if pixels.dtype != np.uint8 or not known or pixels.shape[:2] != shape:
        raise DatasetError(
            f"{where} has shape {pixels.shape} of {pixels.dtype}, expected {(*shape, 3)} or "
            f"{shape} of uint8, as the rig gives its size",
            camera=name,
            frame=number,
        )
    return np.asarray(
        cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if gray else pixels[:, :, :3], np.uint8
    )

"""Datasets of arrays: images and clouds of a program that has them in memory, without files."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import DatasetError
from calibgraph.io.clouds import check_points, with_intensity
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.model.rig import Camera, Rig

_XYZ = 3
_COLOURS = (3, 4)  # channels


@dataclass(frozen=True, eq=False)
class ArrayFrame(Frame):
    """A frame in memory; its paths are names.

    Attributes:
        cloud: (n, 4) x y z [m], intensity.
        images: (height, width, 3) BGR by camera.
    """

    cloud: NDArray[np.float32]
    images: Mapping[str, NDArray[np.uint8]]

    def load_cloud(self) -> NDArray[np.float32]:
        """(n, 4) x y z [m], intensity."""
        return self.cloud

    def load_image(self, name: str, camera: Camera) -> NDArray[np.uint8]:
        """(height, width, 3) image, BGR."""
        return self.images[name]

    def hashes(self) -> dict[str, str]:
        """SHA-256 of the cloud and the images, by their names."""
        arrays: dict[Path, NDArray[Any]] = {self.cloud_path: self.cloud}
        arrays |= {self.image_paths[name]: image for name, image in self.images.items()}
        return {str(path): hashlib.sha256(a.tobytes()).hexdigest() for path, a in arrays.items()}


def dataset_from_arrays(
    rig: Rig,
    clouds: Sequence[NDArray[Any]],
    images: Mapping[str, Sequence[NDArray[np.uint8]]],
) -> Dataset:
    """A dataset of arrays, to be calibrated without files. The arrays are not copied if they fit.

    Args:
        rig: lenses and the guess.
        clouds: per frame (n, 3) x y z or (n, 4) x y z intensity [m] in the LiDAR frame, finite but
            for rows of NaN without a return.
        images: per camera and frame, (height, width, 3) BGR or (height, width) gray, uint8.

    Raises:
        DatasetError: if cameras, frames, shapes or values do not fit together.
    """
    if images.keys() != rig.cameras.keys():
        given = ", ".join(images) or "no camera"
        raise DatasetError(f"images are of {given}, the rig has {', '.join(rig.cameras)}")
    for name, of_camera in images.items():
        if len(of_camera) != len(clouds):
            raise DatasetError(
                f"{len(clouds)} clouds, but {len(of_camera)} images; give one each per frame",
                camera=name,
            )
    if not len(clouds):
        raise DatasetError("no frame given")
    root = Path("arrays") / uuid.uuid4().hex[:8]  # caches tell frames apart by their paths
    frames = tuple(
        _frame(root, number, rig, cloud, {name: images[name][number] for name in rig.cameras})
        for number, cloud in enumerate(clouds)
    )
    return Dataset(rig=rig, frames=frames, folders=(root,))


def _frame(
    root: Path, number: int, rig: Rig, cloud: NDArray[Any], images: Mapping[str, NDArray[np.uint8]]
) -> ArrayFrame:
    name = f"{number:06d}"
    path = root / "lidar" / name
    return ArrayFrame(
        index=number,
        name=name,
        cloud_path=path,
        image_paths={camera: root / camera / name for camera in images},
        cloud=_cloud(cloud, path, number),
        images={
            camera: _image(image, rig.cameras[camera], camera, number)
            for camera, image in images.items()
        },
    )


def _cloud(cloud: NDArray[Any], path: Path, number: int) -> NDArray[np.float32]:
    if cloud.ndim != 2 or cloud.shape[1] < _XYZ or cloud.dtype.kind not in "fiu":  # noqa: PLR2004
        raise DatasetError(
            f"cloud {number} has shape {cloud.shape} of {cloud.dtype}, expected (n, 3) or (n, 4) "
            "numbers",
            frame=number,
        )
    intensity = cloud[:, _XYZ] if cloud.shape[1] > _XYZ else None
    return check_points(with_intensity(cloud[:, :_XYZ], intensity), path)


def _image(image: NDArray[np.uint8], camera: Camera, name: str, number: int) -> NDArray[np.uint8]:
    gray = image.ndim == 2  # noqa: PLR2004
    shape = (camera.height_px, camera.width_px)
    known = gray or (image.ndim == len(_COLOURS) + 1 and image.shape[2] in _COLOURS)
    if image.dtype != np.uint8 or not known or image.shape[:2] != shape:
        raise DatasetError(
            f"image {number} has shape {image.shape} of {image.dtype}, expected {(*shape, 3)} or "
            f"{shape} of uint8, as the rig gives its size",
            camera=name,
            frame=number,
        )
    return np.asarray(
        cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if gray else image[:, :, :3], np.uint8
    )

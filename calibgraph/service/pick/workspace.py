"""A dataset, its session on disk, and the estimate of the pairs so far."""

import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import DatasetError
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.model.rig import Camera
from calibgraph.service.pick.advice import Advice, advise
from calibgraph.service.pick.estimate import PickEstimate, estimate_from_pairs
from calibgraph.service.pick.reference import write_reference
from calibgraph.service.pick.session import SESSION_FILE, Session, open_session
from calibgraph.service.pick.views import VisiblePoints, snap_to_corner, visible_points

_CLOUDS, _IMAGES = 4, 8  # kept in memory: those of the frames between which one goes to and fro

Change = Callable[[Session], Session]


class StaleError(Exception):
    """A change of a session that is no longer the current one."""


class Workspace:
    """A session of picking, for the routes.

    Raises:
        FileError: if the folder holds a session of another dataset.
    """

    def __init__(self, dataset: Dataset, folder: Path) -> None:
        self.dataset, self.folder = dataset, folder
        self._frames = {frame.index: frame for frame in dataset.frames}
        names = [frame.name for frame in dataset.frames]
        self._path = folder / SESSION_FILE
        self._session = open_session(self._path, names, list(dataset.rig.cameras))
        self._lock = threading.Lock()
        self._estimated: tuple[int, PickEstimate] | None = None
        self.cloud = lru_cache(_CLOUDS)(self._load_cloud)
        self.image = lru_cache(_IMAGES)(self._load_image)

    @property
    def session(self) -> Session:
        """As it is now."""
        return self._session

    def change(self, revision: int, change: Change) -> Session:
        """Change the session and save it."""
        with self._lock:
            if revision != self._session.revision:
                raise StaleError
            changed = change(self._session)
            if changed is not self._session:
                changed.save(self._path)
                self._session = changed
            return self._session

    def estimate(self) -> PickEstimate:
        """What the pairs determine; computed once per change."""
        with self._lock:
            session = self._session
            if self._estimated is None or self._estimated[0] != session.revision:
                found = estimate_from_pairs(self.dataset.rig, session.pairs)
                self._estimated = session.revision, found
            return self._estimated[1]

    def camera(self, name: str, *, estimated: bool) -> Camera:
        """A camera at the guess, or at the estimate if there is one."""
        cameras = self.dataset.rig.cameras
        if name not in cameras:
            raise DatasetError(f"the rig has no camera {name!r}; it has {', '.join(cameras)}")
        solve = self.estimate().solve if estimated else None
        return cameras[name] if solve is None else solve.rig.cameras.get(name, cameras[name])

    def frame(self, index: int) -> Frame:
        """The frame of a number."""
        if index not in self._frames:
            raise DatasetError(f"the dataset has no frame {index}")
        return self._frames[index]

    def visible(self, index: int, name: str, *, estimated: bool) -> VisiblePoints:
        """The points of a frame that a camera sees."""
        points = self.cloud(index)[:, :3].astype(np.float64)
        return visible_points(points, self.camera(name, estimated=estimated))

    def corner(
        self, index: int, name: str, pixel_px: tuple[float, float]
    ) -> NDArray[np.float64] | None:
        """The corner near a pixel, None without one."""
        return snap_to_corner(self.image(index, name).mean(axis=2).astype(np.uint8), pixel_px)

    def advice(self, index: int, name: str) -> Advice | None:
        """Where in an image to pick next; None without an estimate of its camera."""
        solve = self.estimate().solve
        if solve is None or name not in solve.rig.cameras:
            return None
        covariance = solve.covariance_of(name)
        if covariance is None:
            return None
        seen = self.visible(index, name, estimated=True)
        points = self.cloud(index)[seen.rows, :3].astype(np.float64)
        return advise(
            solve.rig.cameras[name],
            covariance,
            solve.scale,
            points_lidar_m=points,
            pixels_px=seen.pixels_px,
        )

    def write(self) -> list[Path]:
        """Write the reference and the table of pairs."""
        return write_reference(self.folder, self.estimate(), self._session.pairs)

    def _load_cloud(self, index: int) -> NDArray[np.float32]:
        cloud = self.frame(index).load_cloud()
        cloud.setflags(write=False)
        return cloud

    def _load_image(self, index: int, name: str) -> NDArray[np.uint8]:
        frame = self.frame(index)
        camera = self.camera(name, estimated=False)
        if name not in frame.image_paths:
            raise DatasetError(f"frame {frame.name} has no image of camera {name!r}")
        return frame.load_image(name, camera)

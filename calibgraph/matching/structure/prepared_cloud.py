"""A cloud prepared for matching: own returns removed, intensity ranked, viewpoint determined."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array, Mask
from calibgraph.matching.structure.directions import find_visible, scan_angles, sphere_angles
from calibgraph.matching.structure.prepared_image import Derived
from calibgraph.matching.structure.window_table import WindowTable
from calibgraph.memory import mmap_copy
from calibgraph.model.geometry import camera_center
from calibgraph.model.rig import Camera
from calibgraph.parallel import KeyedCache

MIN_RANGE_M = 1.5  # nearer returns are the vehicle itself
ORIGIN_CELL_RAD, MAX_HIDDEN_FROM_ORIGIN = np.radians(0.3), 0.04
"""Share of points that others hide: seen from a sensor 0.1 to 2.7 %, from a vehicle's base frame
34 %."""


@dataclass(frozen=True, eq=False)
class PreparedCloud:
    """A cloud without the vehicle's own returns.

    Attributes:
        points_lidar_m: (n, 3) in the LiDAR frame.
        intensity_rank: (n,) ranks in (0, 1], independent of the sensor's scale; all equal without
            intensities.
        angles: (n, 2) azimuth and elevation [rad] about the LiDAR frame's origin.
        seen_from_origin: whether the points were measured from the LiDAR frame's origin. Clouds
            that join several sensors, or are in a vehicle's frame, were not.
        derived: where the windows of this and other clouds are kept, see :class:`PreparedImage`.
        identity: by which it knows this cloud; not the cloud, which knows it.
    """

    points_lidar_m: Array
    intensity_rank: Array
    angles: Array
    seen_from_origin: bool
    derived: Derived = field(default_factory=KeyedCache)
    identity: object = field(default_factory=object)

    @staticmethod
    def from_points(cloud: NDArray[np.float32], derived: Derived | None = None) -> PreparedCloud:
        """Prepare a cloud, (n, 4) x y z [m] and intensity (NaN where there is none)."""
        points = cloud[:, :3].astype(np.float64)
        distance_m = np.linalg.norm(points, axis=1)
        far = distance_m > MIN_RANGE_M
        points, distance_m = points[far], distance_m[far]
        intensity = np.nan_to_num(cloud[far, 3].astype(np.float64))
        angles = sphere_angles(points)
        hidden = ~find_visible(scan_angles(angles), distance_m, ORIGIN_CELL_RAD)
        return PreparedCloud(
            mmap_copy(points),
            mmap_copy(_ranks(intensity) / max(1, len(intensity))),
            mmap_copy(angles),
            seen_from_origin=bool(hidden.sum() <= MAX_HIDDEN_FROM_ORIGIN * len(hidden)),
            derived=derived or KeyedCache(),
        )

    @property
    def nbytes(self) -> int:
        """Size in memory, without its windows."""
        return self.points_lidar_m.nbytes + self.intensity_rank.nbytes + self.angles.nbytes

    def viewpoint_lidar_m(self, camera: Camera) -> Array:
        """(3,) from where windows are cut: the LiDAR if it is at the origin, else the camera."""
        T = camera.T_camera_lidar
        return np.zeros(3) if self.seen_from_origin else camera_center(T)

    def windows(
        self,
        camera: Camera,
        usable: Mask,
        spacing_rad: float,
        stride_spacings: float,
        *,
        fine: bool,
    ) -> WindowTable:
        """The windows of the cloud: if it was seen from the origin, the same for every camera.

        Args:
            camera: from where they are cut if it was not.
            usable: (n,) the points that are used if it was not.
            spacing_rad: of the points in a window.
            stride_spacings: of the windows, in spacings of the points.
            fine: keep the linear parts of the variation.
        """
        table = partial(
            WindowTable,
            spacing_rad=spacing_rad,
            stride_spacings=stride_spacings,
            keep_linear=fine,
        )
        if self.seen_from_origin:
            kept: WindowTable = self.derived.get(
                (self.identity, spacing_rad, stride_spacings, fine),
                lambda: table(self.points_lidar_m, self.intensity_rank, self.angles),
            )
            return kept
        rows = np.flatnonzero(usable)
        rays_m = self.points_lidar_m.take(rows, axis=0) - self.viewpoint_lidar_m(camera)
        return table(rays_m, self.intensity_rank[rows], sphere_angles(rays_m), rows)

    def count_windows(
        self, camera: Camera, spacing_rad: float, stride_spacings: float, *, most: int
    ) -> int:
        """Number of fine windows with structure, of a limited number tried all around."""
        everywhere = np.ones(len(self.points_lidar_m), np.bool_)
        table = self.windows(camera, everywhere, spacing_rad, stride_spacings, fine=True)
        return len(table.cut(everywhere, everywhere, max_covered=1.0, max_windows=most))


def _ranks(values: Array) -> Array:
    """Ranks from 1; equal values share the mean of theirs. scipy.stats takes 0.3 s to import."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    ranks: Array = (np.cumsum(count) - (count - 1) / 2)[place]
    return ranks

"""The windows of a cloud, cut where a camera looks and kept for the next pose and camera."""

from threading import Lock

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.arrays import Array, Mask
from calibgraph.matching.structure.directions import thin
from calibgraph.matching.structure.windows import WINDOW, Windows, cut_windows
from calibgraph.memory import mmap_copy, mmap_zeros

Rows = NDArray[np.intp]

_UNCUT, _USELESS = -1, -2


class WindowTable:
    """The windows of a cloud from one viewpoint.

    Centres are in random order, the same for every pose and camera, so that the windows of one
    pose are those of the next as far as it sees them.

    Args:
        rays_m: (m, 3) from the viewpoint to points of the cloud, along the axes of the LiDAR frame.
        intensity_rank: (m,) of the points.
        angles: (m, 2) azimuth and elevation of their rays.
        rows: (m,) their rows in the cloud; None: all.
        spacing_rad: of the points in a window.
        stride_spacings: of the windows, in spacings of the points.
        keep_linear: keep the linear parts of the variation.
    """

    def __init__(
        self,
        rays_m: Array,
        intensity_rank: Array,
        angles: Array,
        rows: Rows | None = None,
        *,
        spacing_rad: float,
        stride_spacings: float,
        keep_linear: bool,
    ) -> None:
        kept = thin(angles, spacing_rad)
        centres = thin(angles[kept], stride_spacings * spacing_rad)
        self._cloud, self._cloud_rows = (rays_m, intensity_rank), rows
        self._rows = mmap_copy(kept.astype(np.int32))
        self._centres = mmap_copy(np.random.default_rng(0).permutation(centres).astype(np.int32))
        self._centre_rows = mmap_copy(self._rows[self._centres])
        directions = rays_m[kept] / np.linalg.norm(rays_m[kept], axis=1, keepdims=True)
        self._tree = cKDTree(directions, balanced_tree=False)
        self._spacing_rad, self._keep_linear = spacing_rad, keep_linear
        self._slots = mmap_copy(np.full(len(centres), _UNCUT, np.int32))
        self._windows: Windows = mmap_zeros((len(centres),), WINDOW)
        self._count = 0
        self._lock = Lock()

    def cut(
        self, in_view: Mask, clear: Mask, *, max_covered: float, max_windows: int, seed: int = 0
    ) -> Windows:
        """Windows whose points are all in view, and mostly clear.

        Args:
            in_view: (n,) of all points of the cloud.
            clear: (n,) those that nothing nearer covers.
            max_covered: share of a window that may be covered.
            max_windows: largest number of centres in view.
            seed: of the choice.
        """
        if self._cloud_rows is not None:
            in_view, clear = in_view.take(self._cloud_rows), clear.take(self._cloud_rows)
        chosen = np.flatnonzero(in_view[self._centre_rows])
        if seed:
            chosen = np.random.default_rng(seed).permutation(chosen)
        windows, slots = self._windows, self._slots_of(chosen[:max_windows])
        rows = windows["members"][slots]
        covered = (windows["front"][slots] & ~clear.take(rows)).mean(axis=1)
        cut: Windows = windows[slots[in_view.take(rows).all(axis=1) & (covered <= max_covered)]]
        return cut

    def _slots_of(self, chosen: Rows) -> Rows:
        """The rows of the windows of those chosen centres that are useful; missing ones are cut."""
        with self._lock:
            missing = chosen[self._slots[chosen] == _UNCUT]
            if len(missing):
                windows, useful = cut_windows(
                    self._cloud, self._centres[missing], (self._tree, self._rows),
                    spacing_rad=self._spacing_rad, keep_linear=self._keep_linear,
                )  # fmt: skip
                first, self._count = self._count, self._count + len(windows)
                self._windows[first : self._count] = windows
                self._slots[missing] = _USELESS
                self._slots[missing[useful]] = np.arange(first, self._count)
            slots = self._slots[chosen].astype(np.intp)
            return slots[slots >= 0]

    @property
    def nbytes(self) -> int:
        """Size in memory, without the cloud."""
        cut = self._count * self._windows.nbytes // max(1, len(self._slots))
        kept = self._rows.nbytes + self._slots.nbytes + 2 * self._centres.nbytes
        return cut + kept + 2 * int(self._tree.data.nbytes)

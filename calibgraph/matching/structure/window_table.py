"""The windows of a cloud, cut where a camera looks and kept for the next pose and camera."""

from collections.abc import Callable, Hashable, Iterable
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.arrays import Array, Mask
from calibgraph.matching.structure.directions import thin
from calibgraph.matching.structure.windows import WINDOW, Windows, cut_windows
from calibgraph.memory import mmap_copy, mmap_zeros
from calibgraph.parallel import KeyedCache

Rows = NDArray[np.intp]

MAX_BYTES, MAX_SELECTED_BYTES = 500_000_000, 220_000_000  # of all tables, and all selections
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


class WindowTables:
    """The tables of several clouds, and what was selected of them: those used last."""

    def __init__(self) -> None:
        self._tables: KeyedCache[tuple[Hashable, ...], WindowTable] = KeyedCache(MAX_BYTES)
        self._selected: KeyedCache[tuple[Hashable, ...], Windows] = KeyedCache(MAX_SELECTED_BYTES)

    def get(self, key: tuple[Hashable, ...], make: Callable[[], WindowTable]) -> WindowTable:
        """The table of a key whose first entry is the cloud; made if it is missing."""
        return self._tables.get(key, make)

    def select(self, key: tuple[Hashable, ...], make: Callable[[], Windows]) -> Windows:
        """The windows that a camera sees, of a key whose first entry is the cloud."""
        return self._selected.get(key, make)

    def keep_only(self, clouds: Iterable[Hashable]) -> None:
        """Drop what is of all other clouds."""
        kept = set(clouds)
        self._tables.keep_only(lambda key: key[0] in kept)
        self._selected.keep_only(lambda key: key[0] in kept)

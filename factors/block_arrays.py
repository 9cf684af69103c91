"""Shared by blocks of correspondences: the scale of the loss, and read-only arrays."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_Number = TypeVar("_Number", bound=np.generic)

_CHUNK = 2048  # correspondences a task: fixed, so that sums do not depend on the thread count


class RobustBlock:
    """A frozen block of residuals with one robust loss.

    Attributes:
        scale: norm of a whitened residual, divided by sigma, at which the loss bends.
        sigma: divides all whitened residuals.
    """

    scale: float
    sigma: float

    def rescale(self, *, scale: float, sigma: float = 1.0) -> Self:
        """The same correspondences, not copied, with another scale of the loss, and sigma."""
        other = self._copy()  # not checked again: its correspondences are of a good block
        other.__dict__.update(scale=scale, sigma=sigma)
        other._check_scale()
        return other

    def _copy(self) -> Self:
        """A block with the same attributes, to be changed; faster than ``copy.copy``."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    def _check_scale(self) -> None:
        if not (self.scale > 0 and self.sigma > 0):
            name = "sigma" if self.scale > 0 else "scale"
            raise ValueError(f"{name} must be positive, found {getattr(self, name)}")

    def _replace(self, **values: Any) -> None:
        """Set attributes of a block that is being made; arrays as views that are read-only."""
        for name, value in values.items():
            array = isinstance(value, np.ndarray)
            self.__dict__[name] = read_only(value) if array else value


def read_only(array: NDArray[_Number]) -> NDArray[_Number]:
    """A view that cannot be written."""
    view = array.view()
    view.setflags(write=False)
    return view


def contiguous(array: NDArray[_Number]) -> NDArray[_Number]:
    """An array in C order, as a view that cannot be written.

    Every array that a kernel only reads is given to it in this form: for arrays that can be
    written, it would be compiled a second time.
    """
    flags = array.flags
    if not flags.c_contiguous:
        array = np.ascontiguousarray(array)
    elif not flags.writeable:
        return array
    view = array.view()
    view.setflags(write=False)
    return view


def check_shape(name: str, array: Array, shape: tuple[int, ...]) -> None:
    """Check an array.

    Raises:
        ValueError: if it has another shape, or values that are not finite.
    """
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise ValueError(f"{name}[{row}] is not finite: {array[row]}")


def join_roots(roots: Sequence[Array | None], counts: Sequence[int]) -> Array | None:
    """Whitening matrices of blocks under each other; the identity where a block has none."""
    if all(root is None for root in roots):
        return None
    return np.concatenate([
        np.tile([1.0, 0.0, 1.0], (count, 1)) if root is None else root
        for root, count in zip(roots, counts, strict=True)
    ])  # fmt: skip


def rows_of_root(root: Array | None) -> tuple[Array | None, int]:
    """(3, n) whitening matrices by columns, and how many of these rows the kernel takes.

    One, if they are all numbers.
    """
    if root is None:
        return None, 0
    isotropic = not root[:, 1].any() and np.array_equal(root[:, 0], root[:, 2])
    return np.ascontiguousarray(root.T), 1 if isotropic else 3


def to_runs(edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """(r, 2) the runs ``edges[i]:edges[i + 1]``, from (r + 1,) edges."""
    runs = np.empty((len(edges) - 1, 2), dtype=np.int64)
    runs[:, 0], runs[:, 1] = edges[:-1], edges[1:]
    return read_only(runs)


def rotate_each(R: Array, vectors: Array) -> Array:
    """Rotate (n, 3) vectors, each by its own of (n, 3, 3), or all by one of (1, 3, 3)."""
    if len(R) == 1:
        return np.asarray(vectors @ R[0].T)
    return np.asarray(np.einsum("nij,nj->ni", R, vectors))


def whiten(columns: Array, root: Array | None) -> None:
    """Multiply (k, 2, n) derivatives or residuals in place by (n, 3) whitening matrices, if any."""
    if root is not None:
        s00, s01, s11 = root.T
        if s01.any():
            columns[:, 0] = s00 * columns[:, 0] + s01 * columns[:, 1]
        else:
            columns[:, 0] *= s00
        columns[:, 1] *= s11


@lru_cache
def chunks(count: int) -> NDArray[np.int64]:
    """(c, 2) runs of _CHUNK of so many correspondences at most."""
    edges = np.arange(0, count + _CHUNK, _CHUNK)
    edges[-1] = count
    return to_runs(edges)

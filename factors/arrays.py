"""Shared by blocks of correspondences: their sums, the scale of the loss, read-only arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from factors.conditioning import unit_diagonal

Array = NDArray[np.float64]
_Number = TypeVar("_Number", bound=np.generic)

_LEAST = 1e-14  # of the largest eigenvalue: below, a direction counts as free
_REGULAR = 1e-10  # least share of an unknown that those before it leave, for Cholesky's root


@dataclass(frozen=True)
class BlockSums:
    """H, b and c of a block of correspondences at one pose. Sums of blocks simply add.

    Attributes:
        hessian: (n, n) or (f, n, n), H of ``factors.block``, in GTSAM's tangent of
            ``T_lidar_camera`` and by further columns.
        gradient: (n,) or (f, n), b.
        cost: () or (f,), c; GTSAM's error is half of it.
        curvature: the second derivative of half the cost, like ``hessian``, where it was asked
            for; but for the second derivative of the residuals, which is their noise over the focal
            length as large.
        weights: (f,) sum of psi, where columns were asked for.
        squares: (f,) sum of psi s, there.
    """

    hessian: Array
    gradient: Array
    cost: Array
    curvature: Array | None = None
    weights: Array | None = None
    squares: Array | None = None

    @staticmethod
    def unpack(sums: Array) -> BlockSums:
        """From (r, 1 to 2, 2 + n, 1 + n) sums of the kernel."""
        n = sums.shape[-1] - 1
        hessian = sums[:, 0, :n, :n]
        return BlockSums(
            hessian,
            sums[:, 0, :n, n],
            sums[:, 0, -1, 0],
            hessian - sums[:, 1, :n, :n] if sums.shape[1] > 1 else None,
            weights=sums[:, 0, -1, 1],
            squares=sums[:, 0, n, n],
        )

    def first(self) -> BlockSums:
        """H, b and c of the first run alone."""
        return BlockSums(self.hessian[0], self.gradient[0], self.cost[0])

    @staticmethod
    def join(parts: Sequence[BlockSums]) -> BlockSums:
        """H, b and c of runs one after the other."""
        names = "hessian", "gradient", "cost"
        return BlockSums(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


class RobustBlock:
    """A frozen block of residuals with Cauchy's loss.

    Attributes:
        scale: norm of a whitened residual, divided by sigma, at which the loss bends; infinite for
            the residuals' squares.
        sigma: divides all whitened residuals.
    """

    scale: float
    sigma: float

    def rescale(self, *, scale: float, sigma: float = 1.0) -> Self:
        """The same correspondences, not copied, with another scale of the loss and sigma."""
        other = self._copy()  # not checked again: its correspondences are of a good block
        other.__dict__.update(scale=scale, sigma=sigma)
        other._check_scales()
        return other

    def with_variance(self, factor: float) -> Self:
        """Residuals with so many times the variance; the loss bends at the same ones [px]."""
        root = factor**0.5
        return self.rescale(scale=self.scale / root, sigma=self.sigma * root)

    def _copy(self) -> Self:
        """A block with the same attributes, to be changed; faster than ``copy.copy``."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    def _check_scales(self) -> None:
        if not (self.scale > 0 and self.sigma > 0):
            name = "sigma" if self.scale > 0 else "scale"
            raise ValueError(f"{name} must be positive, found {getattr(self, name)}")


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
    if not math.isfinite(array.sum()) and not np.isfinite(array).all():  # a sum is faster
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


def square_root(sums: BlockSums) -> tuple[Array, Array]:
    """(n + 1,) error and (n + 1, n) Jacobian with the given H, b and c; H may be rank deficient.

    By Cholesky's root. Where H is nearly rank deficient, it is by the eigenvectors of H with a unit
    diagonal, so that radians and metres lose no digits to each other, and directions without
    information get a zero row.
    """
    size, hessian = len(sums.gradient), sums.hessian
    error, jacobian = np.zeros(size + 1), np.zeros((size + 1, size))
    root = None
    with suppress(np.linalg.LinAlgError):
        root = np.linalg.cholesky(hessian)
    if root is not None and (root.diagonal() ** 2 > _REGULAR * hessian.diagonal()).all():
        error[:size], jacobian[:size] = np.linalg.solve(root, sums.gradient), root.T
    else:
        scaled, units = unit_diagonal(hessian)
        values, vectors = np.linalg.eigh(scaled)
        known = values > _LEAST * max(values[-1], 0.0)
        roots, pulls = np.sqrt(values[known]), vectors.T[known] @ (sums.gradient / units)
        error[:size][known] = pulls / roots
        jacobian[:size][known] = (vectors.T[known] * roots[:, None]) * units
    error[size] = math.sqrt(max(float(sums.cost) - float(error @ error), 0.0))
    return error, jacobian

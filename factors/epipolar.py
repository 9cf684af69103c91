"""Epipolar residuals of two cameras on rays, so that any lens will do.

For unit rays f_a, f_b of one feature and the relative pose (R, t) = T_a_b, both rays and the
baseline lie in one plane where

    C(f_a, f_b) = f_a . (t x R f_b) = 0.

The residual is C over its own standard deviation for pixel errors of 1 px (Sampson's distance; here
with the derivatives of the rays by the pixels, F_a and F_b, instead of a linear lens):

    r = C / D,   D^2 = |C(F_a, f_b)|^2 + |C(f_a, F_b)|^2      [px].

It does not depend on the length of t, which epipolar geometry does not determine.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.block_arrays import RobustBlock, rotate_each
from factors.block_sums import BlockSums, sums_of_runs
from factors.lens import Lens
from factors.loss import loss_id, losses_and_weights
from factors.rays import ray_spreads, unproject

Array = NDArray[np.float64]

_LEAST_SQUARE = 1e-300


@dataclass(frozen=True, eq=False)
class EpipolarBlock(RobustBlock):
    """Co-visible features of two cameras, for epipolar residuals. Immutable.

    Attributes:
        lens_a: of the one camera.
        lens_b: of the other.
        pixels_a_px: (n, 2) features in the one image; every pixel must have a ray.
        pixels_b_px: (n, 2) the same features in the other.
        loss: name of the robust loss.
        scale: of the residual over sigma, at which the loss bends.
        sigma: divides all residuals [px].

    Raises:
        ValueError: on wrong shapes, pixels without a ray, an unknown loss, a scale or sigma <= 0.
    """

    lens_a: Lens
    lens_b: Lens
    pixels_a_px: Array
    pixels_b_px: Array
    loss: str = "cauchy"
    scale: float = 4.0
    sigma: float = 1.0
    _rays: Array = field(init=False, repr=False)  # (n, 18) f_a, F_a, f_b, F_b

    def __post_init__(self) -> None:
        n = len(self.pixels_a_px)
        loss_id(self.loss)
        self._check_scale()
        parts = []
        for name, lens in (("pixels_a_px", self.lens_a), ("pixels_b_px", self.lens_b)):
            pixels = getattr(self, name)
            if pixels.shape != (n, 2):
                raise ValueError(f"{name} has shape {pixels.shape}, expected {(n, 2)}")
            rays, valid = unproject(lens, pixels)
            if not valid.all():
                row = int(np.flatnonzero(~valid)[0])
                raise ValueError(f"{name}[{row}] has no ray: {pixels[row]}")
            spreads = ray_spreads(lens, rays).transpose(0, 2, 1)
            parts += [rays, spreads.reshape(n, 6)]
        self._replace(
            _rays=np.concatenate(parts, axis=1),
            pixels_a_px=np.ascontiguousarray(self.pixels_a_px),
            pixels_b_px=np.ascontiguousarray(self.pixels_b_px),
        )

    def __len__(self) -> int:
        return len(self._rays)

    def select(self, rows: NDArray[Any]) -> EpipolarBlock:
        """The block with only some features: a mask or an index array."""
        other = self._copy()
        names = "_rays", "pixels_a_px", "pixels_b_px"
        other._replace(**{name: getattr(self, name)[rows] for name in names})
        return other

    def sums(self, T_a_b: gtsam.Pose3) -> BlockSums:
        """H, b and c of the whole block, in GTSAM's tangent of ``T_a_b``."""
        sums = self.frame_sums(T_a_b, np.array([0, len(self)]))
        return BlockSums(sums.hessian[0], sums.gradient[0], sums.cost[0])

    def frame_sums(self, T_a_b: gtsam.Pose3, edges: NDArray[np.int64]) -> BlockSums:
        """H, b and c of each run ``edges[i]:edges[i + 1]`` of the features, stacked."""
        return self.run_sums(T_a_b.matrix()[None], edges)

    def run_sums(self, T_a_b: Array, edges: NDArray[np.int64]) -> BlockSums:
        """Like :meth:`frame_sums`, with an (r, 4, 4) pose per run, or one (1, 4, 4) for all."""
        run = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
        T, rays = T_a_b if len(T_a_b) == 1 else T_a_b[run], self._rays[edges[0] : edges[-1]]
        columns = _linearize(T, rays) / self.sigma
        losses, weights = losses_and_weights(loss_id(self.loss), self.scale, columns[:, 6] ** 2)
        return sums_of_runs(columns * np.sqrt(weights)[:, None], losses, edges)

    def residuals(self, T_a_b: gtsam.Pose3) -> Array:
        """(n,) signed epipolar residuals [px], not divided by sigma."""
        return np.asarray(_linearize(T_a_b.matrix()[None], self._rays)[:, 6])


def _linearize(T_a_b: Array, rows: Array) -> Array:
    """(n, 7) derivatives of the residuals in the tangent of T_a_b, and last the residuals [px].

    Args:
        T_a_b: (n, 4, 4) or (1, 4, 4).
        rows: (n, 18) f_a, F_a, f_b, F_b.
    """
    ray_a, *spread_a, ray_b, spread_b, other_b = np.split(rows, 6, axis=1)
    value = _form(T_a_b, ray_a, ray_b)
    sides = [_form(T_a_b, spread, ray_b) for spread in spread_a]
    sides += [_form(T_a_b, ray_a, spread) for spread in (spread_b, other_b)]
    square = np.sum([side[:, 6] ** 2 for side in sides], axis=0)
    known = square > _LEAST_SQUARE  # else no baseline, or both rays along it: no constraint
    square = np.where(known, square, 1.0)[:, None]
    half = np.sum([side[:, :6] * side[:, 6:] for side in sides], axis=0)
    value[:, :6] -= value[:, 6:] / square * half
    return np.asarray(np.where(known[:, None], value / np.sqrt(square), 0.0))


def _form(T_a_b: Array, x: Array, y: Array) -> Array:
    """(n, 7) derivatives of C(x, y), and last C itself."""
    R, back = T_a_b[:, :3, :3], T_a_b[:, :3, :3].transpose(0, 2, 1)
    turned, across = rotate_each(R, y), np.cross(x, T_a_b[:, :3, 3])
    by_rotation = np.cross(y, rotate_each(back, across))
    by_translation = rotate_each(back, np.cross(turned, x))
    return np.column_stack([by_rotation, by_translation, (across * turned).sum(axis=1)])

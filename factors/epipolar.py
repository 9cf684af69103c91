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

import math
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.block_arrays import RobustBlock, contiguous
from factors.block_sums import BlockSums, unpack_sums
from factors.compiled import compiled
from factors.lens import Lens
from factors.loss import loss_and_weight, loss_id
from factors.rays import ray_spreads, unproject

Array = NDArray[np.float64]


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
    _rays: Array = field(init=False, repr=False)  # (n, 18), see _COLUMNS

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
        # Every loss has rho(s / sigma^2; delta) = rho(s; delta sigma) / sigma^2.
        packed = _accumulate(
            contiguous(T_a_b), self._rays, loss_id(self.loss), self.scale * self.sigma, edges
        )
        return unpack_sums(packed / self.sigma**2)

    def residuals(self, T_a_b: gtsam.Pose3) -> Array:
        """(n,) signed epipolar residuals [px], not divided by sigma."""
        R, t = np.ascontiguousarray(T_a_b.rotation().matrix()), np.asarray(T_a_b.translation())
        residuals: Array = _residuals(R, t, self._rays)
        return residuals


@compiled(part=True)
def _form(R, t, x, y, derivative):  # type: ignore[no-untyped-def]
    """C(x, y); its derivative goes into ``derivative``, (6,)."""
    p0 = R[0, 0] * y[0] + R[0, 1] * y[1] + R[0, 2] * y[2]
    p1 = R[1, 0] * y[0] + R[1, 1] * y[1] + R[1, 2] * y[2]
    p2 = R[2, 0] * y[0] + R[2, 1] * y[1] + R[2, 2] * y[2]
    m0, m1, m2 = x[1] * t[2] - x[2] * t[1], x[2] * t[0] - x[0] * t[2], x[0] * t[1] - x[1] * t[0]
    n0 = R[0, 0] * m0 + R[1, 0] * m1 + R[2, 0] * m2
    n1 = R[0, 1] * m0 + R[1, 1] * m1 + R[2, 1] * m2
    n2 = R[0, 2] * m0 + R[1, 2] * m1 + R[2, 2] * m2
    derivative[0] = y[1] * n2 - y[2] * n1
    derivative[1] = y[2] * n0 - y[0] * n2
    derivative[2] = y[0] * n1 - y[1] * n0
    q0, q1, q2 = p1 * x[2] - p2 * x[1], p2 * x[0] - p0 * x[2], p0 * x[1] - p1 * x[0]
    for i in range(3):
        derivative[3 + i] = R[0, i] * q0 + R[1, i] * q1 + R[2, i] * q2
    return m0 * p0 + m1 * p1 + m2 * p2


@compiled(part=True)
def _sampson(R, t, row, jacobian, scratch):  # type: ignore[no-untyped-def]
    """The residual of a feature; its derivative goes into ``jacobian``; ``scratch`` is (2, 6)."""
    ray_a, ray_b = row[0:3], row[9:12]
    value = _form(R, t, ray_a, ray_b, jacobian)
    square = 0.0
    half, side = scratch
    half[:] = 0.0
    for k in range(4):
        at = 3 + 3 * k if k < 2 else 6 + 3 * k  # noqa: PLR2004
        x, y = (row[at : at + 3], ray_b) if k < 2 else (ray_a, row[at : at + 3])  # noqa: PLR2004
        c = _form(R, t, x, y, side)
        square += c * c
        for i in range(6):
            half[i] += c * side[i]
    if square < 1e-300:  # noqa: PLR2004 - no baseline, or both rays along it: no constraint
        jacobian[:] = 0.0
        return 0.0
    over = 1.0 / math.sqrt(square)
    for i in range(6):
        jacobian[i] = over * (jacobian[i] - value / square * half[i])
    return value * over


@compiled()
def _accumulate(T_a_b, rays, loss, scale, edges):  # type: ignore[no-untyped-def]
    """(segments, 28) sums: 21 of the upper triangle of H, 6 of b, 1 of c."""
    out = np.zeros((len(edges) - 1, 28))
    jacobian, scratch = np.empty(6), np.empty((2, 6))
    for segment in range(len(edges) - 1):
        T = T_a_b[min(np.int64(segment), len(T_a_b) - 1)]
        R, t, sums = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), out[segment]
        for k in range(edges[segment], edges[segment + 1]):
            r = _sampson(R, t, rays[k], jacobian, scratch)
            rho, psi = loss_and_weight(loss, scale, r * r)
            sums[27] += rho
            place = 0
            for i in range(6):
                sums[21 + i] += psi * jacobian[i] * r
                for j in range(i, 6):
                    sums[place] += psi * jacobian[i] * jacobian[j]
                    place += 1
    return out


@compiled()
def _residuals(R, t, rays):  # type: ignore[no-untyped-def]
    out = np.empty(len(rays))
    jacobian, scratch = np.empty(6), np.empty((2, 6))
    for k in range(len(rays)):
        out[k] = _sampson(R, t, rays[k], jacobian, scratch)
    return out

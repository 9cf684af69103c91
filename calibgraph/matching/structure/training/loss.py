"""How unlikely the trusted pose is under the graph of a camera's matches, by its windows' weights.

A group of windows sums their scores; the quadratic through its peak near the truth is its match,
as in ``peaks``. The matches' optimum and information are those of ``solver.pose_loss``, which are
differentiated implicitly: by every match's pixel and the logarithm of its weight. The directions
that matches constrain and the spread of their residuals are taken as they are.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from calibgraph.matching.optimum_loss import optimum_loss
from calibgraph.matching.structure.peaks import MIN_CURVATURE_RATIO, PEAK_STEPS, QUADRATIC_FIT
from calibgraph.matching.structure.training.samples import LEVEL, NEAR, SIDE, CameraWindows
from calibgraph.model.error_components import error_components
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.solver.camera_block import MIN_MATCHES
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS
from calibgraph.solver.whitening import MEDIAN_NORM, upper_root
from factors import ProjectionBlock, pose_sigmas

_PRIOR_SIGMAS = pose_sigmas(rotation_rad=LEVEL.rotation_rad, translation_m=LEVEL.translation_m)
"""As wide as the level searches: few matches determine no pose without a prior."""


def damped(scores: Tensor, weights: Tensor) -> Tensor:
    """-log(1 - w (1 - exp(-s))) of scores (w, ...) by weights (w,)."""
    shaped = weights.reshape(-1, *[1] * (scores.ndim - 1))
    return -torch.log1p(-shaped * -torch.expm1(-scores))


def pose_negative_log_likelihood(weights: Tensor, sample: CameraWindows) -> Tensor | None:
    """Of the trusted pose; None if too few groups match.

    Args:
        weights: (w,) of the windows, differentiable.
        sample: of one camera.
    """
    near, chance = (torch.as_tensor(part) for part in (sample.near, sample.chance))
    group, count = torch.as_tensor(sample.group), len(sample.points_lidar_m)
    above = damped(near, weights) - damped(chance, weights).mean(1)[:, None, None]
    grids = near.new_zeros(count, SIDE, SIDE).index_add(0, group, above)
    total = near.new_zeros(count).index_add(0, group, weights)
    shift, hessian, peak = _peaks(grids)
    quality = peak / total.clamp(min=1e-6)
    trace = hessian.diagonal(dim1=1, dim2=2).sum(1)
    good = ((quality > LEVEL.min_quality) & (trace > 0)).nonzero()[:, 0]
    if len(good) < MIN_MATCHES:
        return None
    scale = torch.as_tensor(sample.steps_per_px)
    pixels = torch.as_tensor(sample.pixels_px)[good] + shift[good].double() / scale
    log_weights = 0.5 * torch.log(quality[good] * trace[good]).double()
    roots = _directions(hessian[good] / trace[good, None, None], sample.steps_per_px)
    log_weights = log_weights - log_weights.mean()
    block = _block(pixels, log_weights, sample, rows=good.numpy(), roots=roots)
    T = sample.camera.T_camera_lidar
    prior = to_T_lidar_camera(T), _PRIOR_SIGMAS
    return optimum_loss(block, T, prior, pixels_px=pixels, log_weights=log_weights)


def _block(
    pixels: Tensor,
    log_weights: Tensor,
    sample: CameraWindows,
    *,
    rows: np.ndarray,
    roots: np.ndarray,
) -> ProjectionBlock:
    """The matches of the groups in these rows, by the roots of their information."""
    camera = sample.camera
    block = ProjectionBlock(
        camera.lens, sample.points_lidar_m[rows], pixels.detach().numpy(),
        roots * np.exp(log_weights.detach().numpy())[:, None],
    )  # fmt: skip
    # What matches of a place share widens the information, not the loss.
    widened = math.sqrt(error_components().matchers["structure"].place_variance)
    sigma = widened * _spread(block, camera.T_camera_lidar)
    return block.rescale(scale=CAUCHY_SCALE_SIGMAS / widened, sigma=sigma)


def _directions(shapes: Tensor, steps_per_px: np.ndarray) -> np.ndarray:
    """(n, 3) roots of the information of pixels, of Hessians (n, 2, 2) by steps."""
    by_px = shapes.detach().double().numpy() * np.outer(steps_per_px, steps_per_px)
    return upper_root(by_px.reshape(-1, 4)[:, [0, 1, 3]])


def _peaks(grids: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As ``peaks.find_local_peaks`` about the truth, differentiable; no peak has no curvature."""
    count, inner = len(grids), slice(NEAR - PEAK_STEPS, NEAR + PEAK_STEPS + 1)
    span = 2 * PEAK_STEPS + 1
    top = grids.detach()[:, inner, inner].reshape(count, -1).argmax(1)
    row, column = NEAR - PEAK_STEPS + top // span, NEAR - PEAK_STEPS + top % span
    around, index = torch.arange(-1, 2), torch.arange(count)[:, None, None]
    patches = grids[index, (row[:, None] + around)[:, :, None], (column[:, None] + around)[:, None]]
    fit = patches.reshape(count, 9) @ torch.as_tensor(QUADRATIC_FIT.T, dtype=torch.float32)
    hessian = -fit[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
    vectors = torch.linalg.eigh(hessian.detach())[1]  # to first order values follow the matrix
    values = torch.einsum("gji,gjk,gki->gi", vectors, hessian, vectors)
    kept = values > (MIN_CURVATURE_RATIO * values[:, 1:]).clamp(min=1e-9)
    along = torch.einsum("gji,gj->gi", vectors, fit[:, 1:3]) / torch.where(kept, values, 1.0)
    offset = torch.einsum("gij,gj->gi", vectors, torch.where(kept, along, 0.0))
    inside = offset.detach().abs().amax(1) < 1.5  # noqa: PLR2004
    curvatures = torch.where(kept & inside[:, None], values, 0.0)
    shift = torch.stack([column, row], 1) - NEAR + offset.clamp(-1, 1)
    return shift, torch.einsum("gij,gj,gkj->gik", vectors, curvatures, vectors), patches[:, 1, 1]


def _spread(block: ProjectionBlock, T_camera_lidar: np.ndarray) -> float:
    """Robust standard deviation of the whitened residuals at a pose."""
    return max(float(np.median(block.run_norms(T_camera_lidar[None])[-1]) / MEDIAN_NORM[1]), 1e-9)

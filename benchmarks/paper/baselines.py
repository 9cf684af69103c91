"""What our method is compared with: the solver that the paper publishes."""

from collections.abc import Callable, Mapping
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibgraph.model.config import Config, Terms
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import invert, relative_transform, transform
from calibgraph.model.rig import Rig
from calibgraph.solver.matches import CameraBlock, camera_blocks
from calibgraph.solver.two_pass import Transforms

Array = NDArray[np.float64]

TRF_TOLERANCE = 1e-6
TRF_MAX_EVALUATIONS = 2000
_DIMENSIONS = 6  # of an extrinsic


def paper_solve(
    rig: Rig, table: Correspondences, T_hat: Transforms, config: Config, terms: Terms
) -> Transforms:
    """The paper's Stage 2 as published: SciPy's TRF from Stage 1; fit, gate, refit.

    Args:
        rig: lenses, and the order of the cameras.
        table: preprocessed correspondences.
        T_hat: (4, 4) Stage-1 estimate of T_camera_lidar per camera; also the start.
        config: with ``loss_scale_px`` and ``gate_px``.
        terms: terms of the objective.

    Raises:
        ValueError: if the settings leave scales to the data.
    """
    if config.loss_scale_px is None or config.gate_px is None:
        raise ValueError("the paper's solver needs a loss_scale_px and a gate_px")
    if terms == "stage1":
        return dict(T_hat)
    blocks = camera_blocks(rig, table, config) if terms != "priors" else {}
    first = _minimize_pass(blocks, T_hat, T_hat, config, terms)
    inliers = {
        name: block.without_outliers(first[name], block.scale(first[name], config))
        for name, block in blocks.items()
    }
    return _minimize_pass(inliers, first, T_hat, config, terms)


def _minimize_pass(
    blocks: Mapping[str, CameraBlock], start: Transforms, T_hat: Transforms, config: Config,
    terms: Terms,
) -> Transforms:  # fmt: skip
    def residuals(T: Transforms) -> Array:
        rows = [_weighted_residuals(block, T[name]) for name, block in blocks.items()]
        return np.concatenate([*rows, np.empty((0, 2))])

    def priors(T: Transforms) -> Array:
        return prior_rows(T, T_hat, config) if terms != "reprojection" else np.empty(0)

    return minimize_trf(residuals, priors, start, scale_px=config.loss_scale_px or np.inf)


def _weighted_residuals(matches: CameraBlock, T_camera_lidar: Array) -> Array:
    """(n, 2) w (pi(T p) - u) [px]."""
    residuals, _ = matches.block.residuals(T_camera_lidar[None])
    root = matches.block.sqrt_information
    if root is None:
        return residuals
    first = root[:, 0] * residuals[:, 0] + root[:, 1] * residuals[:, 1]
    return np.column_stack([first, root[:, 2] * residuals[:, 1]])


def prior_rows(T: Transforms, T_hat: Transforms, config: Config) -> Array:
    """Both priors of Eq. 5 as residuals; the sum of their squares is the prior terms.

    Args:
        T: (4, 4) T_camera_lidar per camera.
        T_hat: Stage-1 estimates; the relative prior is over each camera with the next.
        config: lambda and mu.
    """
    rows = [np.sqrt(config.prior_weight) * _log(invert(T_hat[a]) @ T[a]) for a in T_hat]
    for a, b in pairwise(T_hat):
        T_hat_b_a, T_b_a = relative_transform(T_hat[b], T_hat[a]), relative_transform(T[b], T[a])
        rows.append(np.sqrt(config.relative_prior_weight) * _log(invert(T_hat_b_a) @ T_b_a))
    return np.concatenate(rows)


def _log(T: Array) -> Array:
    """(6,) logarithm of a (4, 4) transform: rotation [rad], translation [m]."""
    return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(T)))


def minimize_trf(
    residuals: Callable[[Transforms], Array], priors: Callable[[Transforms], Array],
    start: Transforms, *, scale_px: float,
) -> Transforms:  # fmt: skip
    """Minimize sum rho(|r_k|^2) + sum priors^2 by SciPy's TRF, as in "Implementation Details".

    Axis-angle and translation per camera, tolerances of 1e-6, at most 2000 evaluations, a Jacobian
    by differences. SciPy's own losses are of single components and would take in the priors, so
    Cauchy's is put into the residuals: r_k sqrt(rho(|r_k|^2)) / |r_k|, whose square is rho. With
    the lengths |r_k| as residuals TRF needs up to thirty times as many evaluations, and stops
    farther from the minimum.

    Args:
        residuals: (n, 2) weighted residuals at given extrinsics [px].
        priors: (m,) residuals of the priors there.
        start: (4, 4) T_camera_lidar per camera.
        scale_px: delta.
    """
    names = list(start)

    def stack(x: Array) -> Array:
        T = _unpack(names, x)
        return np.concatenate([_apply_cauchy(residuals(T), scale_px).ravel(), priors(T)])

    x0 = np.concatenate([_pack(T) for T in start.values()])
    found = least_squares(
        stack, x0, method="trf", ftol=TRF_TOLERANCE, xtol=TRF_TOLERANCE,
        max_nfev=TRF_MAX_EVALUATIONS,
    )  # fmt: skip
    return _unpack(names, found.x)


def _apply_cauchy(r: Array, scale_px: float) -> Array:
    """(n, 2) residuals scaled so that their squares are rho(|r|^2) = delta^2 log(1 + s)."""
    s = np.maximum(np.einsum("ij,ij->i", r, r) / scale_px**2, np.finfo(float).eps)
    return np.asarray(r * np.sqrt(np.log1p(s) / s)[:, None])


def _pack(T: Array) -> Array:
    """(6,) axis-angle [rad] and translation [m] of a (4, 4)."""
    return np.append(Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3])


def _unpack(names: list[str], x: Array) -> Transforms:
    """The (4, 4) of each camera from (6 N,) axis-angles and translations."""
    each = zip(names, x.reshape(-1, _DIMENSIONS), strict=True)
    return {name: transform(Rotation.from_rotvec(six[:3]), six[3:]) for name, six in each}

"""What ours is compared with: the paper's own solver, one camera at a time, and a bound."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibgraph.model.config import Config, Terms
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.model.rig import Rig
from calibgraph.solver.camera_block import CameraBlock, camera_blocks
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.objective import Objective, Transforms
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS, robust_spread
from calibgraph.solver.stage1 import Stage1

Array = NDArray[np.float64]

TRF_TOLERANCE = 1e-6
TRF_MAX_EVALUATIONS = 2000
_DIMENSIONS = 6  # of a pose


def paper_solve(
    rig: Rig, table: Correspondences, T_hat: Transforms, config: Config, terms: Terms
) -> Transforms:
    """The paper's Stage 2 as it describes it: SciPy's TRF, fit, gate, refit, from Stage 1.

    Args:
        rig: lenses, and the order of the cameras.
        table: preprocessed correspondences.
        T_hat: (4, 4) Stage-1 estimate of T_camera_lidar per camera; also the start.
        config: with ``loss_scale_px`` and ``gate_px``: the preset kitti or walkley, say. Its loss
            must be Cauchy's.
        terms: which parts of the objective.

    Returns:
        (4, 4) T_camera_lidar per camera.

    Raises:
        ValueError: if the settings leave scales open, or have another loss.
    """
    if config.loss_scale_px is None or config.gate_px is None or config.loss != "cauchy":
        raise ValueError("the paper's solver needs a Cauchy loss, its loss_scale_px and a gate_px")
    if terms == "stage1":
        return dict(T_hat)
    matches = camera_blocks(rig, table, config) if terms != "priors" else {}
    first = _one_pass(matches, T_hat, T_hat, config, terms)
    inside = {
        name: m.without_outliers(first[name], m.scale(first[name], config))
        for name, m in matches.items()
    }
    return _one_pass(inside, first, T_hat, config, terms)


def _one_pass(
    matches: Mapping[str, CameraBlock],
    start: Transforms,
    T_hat: Transforms,
    config: Config,
    terms: Terms,
) -> Transforms:
    def residuals(T: Transforms) -> Array:
        rows = [_weighted_residuals(m, T[name]) for name, m in matches.items()]
        return np.concatenate([*rows, np.empty((0, 2))])

    def priors(T: Transforms) -> Array:
        return prior_rows(T, T_hat, config) if terms != "reprojection" else np.empty(0)

    return minimize_trf(residuals, priors, start, scale_px=config.loss_scale_px or np.inf)


def _weighted_residuals(matches: CameraBlock, T_camera_lidar: Array) -> Array:
    """(n, 2) w (pi(T p) - u) [px]."""
    residuals, _ = matches.block.residuals(to_T_lidar_camera(T_camera_lidar))
    root = matches.block.sqrt_information
    if root is None:
        return residuals
    first = root[:, 0] * residuals[:, 0] + root[:, 1] * residuals[:, 1]
    return np.column_stack([first, root[:, 2] * residuals[:, 1]])


def prior_rows(T: Transforms, T_hat: Transforms, config: Config) -> Array:
    """Both priors of Eq. 5 as residuals: the sum of their squares are its two terms.

    Args:
        T: (4, 4) T_camera_lidar per camera.
        T_hat: Stage-1 estimates; the relative prior is over each camera with the next.
        config: lambda and mu.
    """
    hat, now = ({name: gtsam.Pose3(pose) for name, pose in p.items()} for p in (T_hat, T))
    rows = [
        np.sqrt(config.prior_weight) * gtsam.Pose3.Logmap(hat[name].inverse().compose(now[name]))
        for name in hat
    ]
    for one, two in pairwise(hat):
        relative = hat[two].compose(hat[one].inverse())
        step = relative.inverse().compose(now[two].compose(now[one].inverse()))
        rows.append(np.sqrt(config.relative_prior_weight) * gtsam.Pose3.Logmap(step))
    return np.concatenate(rows)


def minimize_trf(
    residuals: Callable[[Transforms], Array],
    priors: Callable[[Transforms], Array],
    start: Transforms,
    *,
    scale_px: float,
) -> Transforms:
    """Minimize sum rho(|r_k|^2) + sum priors^2 by SciPy's TRF, as in "Implementation Details".

    Axis-angle and translation per camera, tolerances of 1e-6, at most 2000 evaluations, a Jacobian
    by differences. SciPy's own losses are of single components and would take in the priors, so
    Cauchy's is put into the residuals: r_k sqrt(rho(|r_k|^2)) / |r_k|, whose square is rho. That
    serves TRF well; with the lengths |r_k| as residuals it needs up to thirty times as many
    evaluations, and stops farther from the minimum.

    Args:
        residuals: (n, 2) weighted residuals at some poses [px].
        priors: (m,) residuals of the priors there.
        start: (4, 4) T_camera_lidar per camera.
        scale_px: delta.
    """
    names = list(start)

    def stacked(x: Array) -> Array:
        T = _unpacked(names, x)
        return np.concatenate([_with_cauchy(residuals(T), scale_px).ravel(), priors(T)])

    x0 = np.concatenate([_six(T) for T in start.values()])
    found = least_squares(
        stacked, x0, method="trf", ftol=TRF_TOLERANCE, xtol=TRF_TOLERANCE,
        max_nfev=TRF_MAX_EVALUATIONS,
    )  # fmt: skip
    return _unpacked(names, found.x)


def _with_cauchy(r: Array, scale_px: float) -> Array:
    """(n, 2) residuals, made so long that their squares are rho(|r|^2) = delta^2 log(1 + s)."""
    s = np.maximum(np.einsum("ij,ij->i", r, r) / scale_px**2, np.finfo(float).eps)
    return np.asarray(r * np.sqrt(np.log1p(s) / s)[:, None])


def _six(T: Array) -> Array:
    return np.append(Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3])


def _unpacked(names: list[str], x: Array) -> Transforms:
    poses = {}
    for name, six in zip(names, x.reshape(-1, _DIMENSIONS), strict=True):
        poses[name] = np.eye(4)
        poses[name][:3, :3] = Rotation.from_rotvec(six[:3]).as_matrix()
        poses[name][:3, 3] = six[3:]
    return poses


def per_camera_adjustment(
    rig: Rig, table: Correspondences, config: Config, *, pairwise: Stage1 | None = None
) -> Transforms:
    """Bundle adjustment of each camera alone: the two passes with its reprojection term only.

    Args:
        rig: lenses and the guess; its relative poses are not used.
        table: correspondences.
        config: with the scales of the loss and the gate.
        pairwise: estimates of all cameras, if it is known.
    """
    poses: Transforms = {}
    for name, camera in rig.cameras.items():
        alone = Rig(lidar=rig.lidar, cameras={name: camera})
        rows = table.of_camera(name)
        own = replace(rows, cameras=(name,), camera_index=np.zeros_like(rows.camera_index))
        poses |= solve_joint(alone, own, config, "reprojection", pairwise=pairwise).T_camera_lidar
    return poses


def oracle_solve(rig: Rig, table: Correspondences, truth: Transforms, config: Config) -> Transforms:
    """About a bound: the reprojection term with weights that only a simulation can know.

    Every frame of a camera is weighted by the inverse of what its matches say wrongly: the mean
    square of their noise, plus the mean square error of the frame's own pose in units of a single
    match. Both are measured at the true poses. The fit starts there; loss and gate follow the
    residuals' own spread, as with ``auto``. An error that all frames share is beyond weights, and
    frames that make up for it by errors of their own are then preferred.

    Args:
        rig: lenses, and the order of the cameras.
        table: preprocessed correspondences.
        truth: (4, 4) true T_camera_lidar per camera.
        config: settings; those of the preset ``auto``, say.
    """
    matches = {
        name: m.with_weights(oracle_weights(m, truth[name]))
        for name, m in camera_blocks(rig, table, config).items()
    }
    alone = Rig(lidar=rig.lidar, cameras=rig.cameras)
    objective = Objective(alone, matches, {}, config, "reprojection")
    poses, scales = objective.minimize_with_scale(truth)
    return objective.without_outliers(poses, scales).minimize(poses, scales).T_camera_lidar


def oracle_weights(matches: CameraBlock, T_camera_lidar: Array) -> Array:
    """(n,) a weight per match, alike in a frame and at most 1, from the true pose.

    With the spread s of a frame's residuals and, for its own pose, the squared error b^T H^-1 b
    over 6 (one Gauss-Newton step from the truth), it is 1 / (s^2 + b^T H^-1 b / 6): for a frame
    that errs by noise alone the second is s^2 on average.
    """
    weights = []
    for edge in pairwise(matches.frame_edges):
        part = matches.select(np.arange(*edge))
        spread = robust_spread(part.sizes(T_camera_lidar)[1])
        block = replace(part.block, scale=CAUCHY_SCALE_SIGMAS * max(spread, part.least_spread))
        sums = block.sums(to_T_lidar_camera(T_camera_lidar))
        wrong = sums.gradient @ np.linalg.pinv(sums.hessian, hermitian=True) @ sums.gradient
        weights.append(1 / (spread**2 + wrong / _DIMENSIONS + part.least_spread**2))
    each = np.repeat(weights, np.diff(matches.frame_edges))
    return np.asarray(each / each.max())

"""The joint solve of picked pairs over all cameras, with plain least squares.

No loss and no gate: with a dozen pairs a robust loss hides a wrong one and makes the error bar
depend on it. A wrong pair is found by what leaving it out changes (the influences here), and
removed by its picker.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.special import fdtrc

from calibgraph.arrays import Array
from calibgraph.graph.objective import objective_graph
from calibgraph.model.config import Config
from calibgraph.model.geometry import pose_rows
from calibgraph.model.rig import Camera, Rig
from calibgraph.service.pick.session import Pair, pixels_of, points_of, sigmas_of
from calibgraph.solver.camera_twist import project_with_jacobian
from calibgraph.solver.curvature import pose_hessian
from calibgraph.solver.optimizer import optimize
from factors import ProjectionBlock
from factors.conditioning import invert_or_none

PSEUDO_RESIDUALS = 8.0
"""Residuals of the stated sigma that are added to the measured ones: those of four pairs, so that
the error bar rests on the statement while there are fewer than that, and on the residuals later."""

_POSE = 6
_FREE = 1e-9  # smallest over largest eigenvalue of a unit-diagonal Hessian: below, one is free
_SCALINGS = 3  # the scale only moves the solution where relative poses take part


@dataclass(frozen=True, eq=False)
class JointSolve:
    """The extrinsics that fit all pairs best, and how well they are determined.

    Attributes:
        rig: of the cameras that are solved, at the solution.
        covariance: (6 N, 6 N) of xi in T_camera_lidar = exp(xi) T, camera after camera; None if a
            direction is free.
        scale: measured over stated standard deviation of the pixels.
        freedom: residuals less unknowns.
    """

    rig: Rig
    covariance: Array | None
    scale: float
    freedom: int

    def rows(self, camera: str) -> slice:
        """The rows of a camera in the covariance."""
        return pose_rows(list(self.rig.cameras).index(camera))

    def covariance_of(self, camera: str) -> Array | None:
        """(6, 6) of one camera."""
        if self.covariance is None:
            return None
        rows = self.rows(camera)
        block: Array = self.covariance[rows, rows]
        return block


def solve_pairs(rig: Rig, pairs: Mapping[str, Sequence[Pair]]) -> JointSolve:
    """Solve all cameras of a rig jointly: the paper's Eq. 5 with its reprojection term alone."""
    freedom = 2 * sum(map(len, pairs.values())) + _POSE * (
        len(rig.relative_poses) - len(rig.cameras)
    )
    scale = 1.0
    for _ in range(_SCALINGS if rig.relative_poses else 1):
        graph = _graph(rig, pairs, scale)
        optimum = optimize(graph, list(rig.cameras), rig.T_camera_lidar)
        rig = rig.moved_to(optimum.T_camera_lidar)
        squares = sum(
            float((whitened_residuals(rig.cameras[name], some) ** 2).sum())
            for name, some in pairs.items()
        )
        scale = float(np.sqrt((PSEUDO_RESIDUALS + squares) / (PSEUDO_RESIDUALS + max(freedom, 0))))
    hessian = pose_hessian(_graph(rig, pairs, scale), list(rig.cameras), rig.T_camera_lidar)
    return JointSolve(rig, invert_or_none(hessian, least=_FREE), scale, freedom)


def _graph(
    rig: Rig, pairs: Mapping[str, Sequence[Pair]], scale: float
) -> gtsam.NonlinearFactorGraph:
    blocks = {name: _block(rig.cameras[name], some, scale) for name, some in pairs.items()}
    return objective_graph(rig, blocks, {}, Config(), terms="reprojection")


def _block(camera: Camera, pairs: Sequence[Pair], scale: float) -> ProjectionBlock:
    root = 1.0 / sigmas_of(pairs)
    return ProjectionBlock(
        camera.lens,
        points_of(pairs),
        pixels_of(pairs),
        sqrt_information=np.column_stack([root, np.zeros_like(root), root]),
        loss="l2",
        sigma=scale,
    )


def whitened_residuals(camera: Camera, pairs: Sequence[Pair]) -> Array:
    """(n, 2) projection less pixel, over the stated sigma."""
    T = camera.T_camera_lidar
    projected, _ = camera.lens.project(points_of(pairs) @ T[:3, :3].T + T[:3, 3])
    residuals: Array = (projected - pixels_of(pairs)) / sigmas_of(pairs)[:, None]
    return residuals


FALSE_ALARMS = 0.01
"""Share of results without a wrong pair in which one is called suspicious."""

_OF_A_PAIR = 2  # residuals


@dataclass(frozen=True)
class Influence:
    """One pair in a result.

    Attributes:
        residual_px: (column, row) of the projected point less the pixel.
        moves_deg, moves_cm: how far its camera turns and shifts without it; None if the camera is
            not determined without it.
        p: probability of so large a disagreement with all others by chance; None with too few.
        suspicious: whether p is below FALSE_ALARMS, of all pairs together.
    """

    residual_px: tuple[float, float]
    moves_deg: float | None
    moves_cm: float | None
    p: float | None
    suspicious: bool


def influences(
    solve: JointSolve, pairs: Mapping[str, Sequence[Pair]]
) -> dict[str, list[Influence]]:
    """Per camera and pair: residual, and the change by one Gauss-Newton step without it."""
    count = sum(map(len, pairs.values()))
    return {name: _of_camera(solve, name, some, count) for name, some in pairs.items()}


def _of_camera(solve: JointSolve, name: str, pairs: Sequence[Pair], count: int) -> list[Influence]:
    camera, sigmas = solve.rig.cameras[name], sigmas_of(pairs)
    residuals = whitened_residuals(camera, pairs)
    jacobians = project_with_jacobian(camera, points_of(pairs))[1] / sigmas[:, None, None]
    covariance = solve.covariance_of(name)
    return [
        _influence(
            solve, covariance, residuals[i], jacobians[i], sigma_px=float(sigmas[i]), count=count
        )
        for i in range(len(pairs))
    ]


def _influence(
    solve: JointSolve,
    covariance: Array | None,
    residual: Array,
    jacobian: Array,
    *,
    sigma_px: float,
    count: int,
) -> Influence:
    """Of one pair, by the matrix inversion lemma.

    Args:
        solve: for the freedom and the scale.
        covariance: (6, 6) of its camera.
        residual: (2,) whitened by the stated sigma.
        jacobian: (2, 6) likewise.
        sigma_px: stated.
        count: pairs in all.
    """
    u, v = (residual * sigma_px).tolist()
    if covariance is None:
        return Influence((u, v), None, None, None, False)
    C = covariance / solve.scale**2
    # Without the pair, H' = H - J^T J and the gradient is -J^T r, so that the step is
    # H'^-1 J^T r = C J^T (I - J C J^T)^-1 r.
    left = np.eye(2) - jacobian @ C @ jacobian.T
    if np.linalg.eigvalsh(left)[0] < np.sqrt(np.finfo(float).eps):
        return Influence((u, v), None, None, None, False)
    deleted = np.linalg.solve(left, residual)
    step = C @ jacobian.T @ deleted
    p = _chance(solve, float(residual @ deleted))
    return Influence(
        (u, v),
        float(np.degrees(np.linalg.norm(step[:3]))),
        float(100 * np.linalg.norm(step[3:])),
        p,
        p is not None and p < FALSE_ALARMS / count,
    )


def _chance(solve: JointSolve, drop: float) -> float | None:
    """Probability that one pair adds so much to the sum of squares, by an F test (2, rest)."""
    if solve.freedom <= _OF_A_PAIR:  # without a pair, the others fit whatever they are
        return None
    rest = PSEUDO_RESIDUALS + solve.freedom - _OF_A_PAIR
    squares = solve.scale**2 * (PSEUDO_RESIDUALS + solve.freedom) - drop
    return float(fdtrc(_OF_A_PAIR, rest, (drop / _OF_A_PAIR) / (squares / rest)))

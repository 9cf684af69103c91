"""What a result depends on: each pair's residual, and what leaving it out changes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from calibgraph.arrays import Array
from calibgraph.service.pick.joint import (
    PSEUDO_RESIDUALS,
    JointSolve,
    pixel_jacobians,
    whitened_residuals,
)
from calibgraph.service.pick.pairs import Pair, points_of, sigmas_of

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
    jacobians = pixel_jacobians(camera, points_of(pairs)) / sigmas[:, None, None]
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

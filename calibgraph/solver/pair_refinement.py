"""What cameras see in common: the last step of the joint solve, and a fit of one pair alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.findings import error_components
from calibgraph.model.geometry import (
    invert,
    local_coordinates,
    pose_rows,
    relative_covariance,
    relative_transform,
    retract_all,
    to_T_lidar_camera,
    twist_between,
)
from calibgraph.solver.covariance import FittedObjective
from calibgraph.solver.pairs import (
    ENOUGH_SURFACES,
    PairTerm,
    rows_of_pair,
    usual_excess,
)
from calibgraph.solver.places import lengthen
from calibgraph.solver.pnp import DAMPING
from calibgraph.solver.two_pass import RELATIVE_TOLERANCE, Objective, Optimum
from factors import pose_sigmas

_NARROWINGS = 3  # steps at most from the spread at the estimate to the least one, by half each
_COARSE = 1e-5  # relative change of the error at which each of them stops
_MAX_STEPS, _MAX_STEP, _CONVERGED = 30, 0.1, 1e-5  # of a pair alone: rad, m
_SETTLED, _MOST = 0.005, 9  # relative change of a spread that ends its measuring, and its steps
Places = Mapping[frozenset[str], Mapping[str, Array]]
_HELD_RAD, _HELD_M = np.radians(1.0), 0.2  # of the first camera, while its pair is fitted alone


def refine_with_pairs(
    at: FittedObjective, terms: Sequence[PairTerm], alone: Places
) -> tuple[Objective, Optimum] | None:
    """Minimize again with the terms of camera pairs, their sigmas narrowed step by step; gate; fit.

    At an estimate that is wrong, residuals are large, and so would be the spread by which they are
    weighed: a pair could not correct it. So the last sigmas are those where pairs alone place their
    cameras.

    Args:
        at: the minimum without pairs.
        terms: of pairs, with surfaces that are taken near the minimum.
        alone: by :func:`place_pairs`.

    Returns:
        The objective with the pairs' inliers, and its minimum; None where no pair of cameras has
        enough in common, or the correspondences are not used.
    """
    inliers, T = at.objective, at.T_camera_lidar
    if not terms or not inliers.uses_correspondences:
        return None
    least = np.array([term.sigma_px(alone[term.pair]) for term in terms])
    now = np.array([term.sigma_px(T) for term in terms])
    steps = int(np.clip(np.ceil(np.log2((now / least).max())), 1, _NARROWINGS))
    for step in range(steps):
        now = now if step == 0 else np.array([term.sigma_px(T) for term in terms])
        sigmas = least * np.maximum(now / least, 1.0) ** (1.0 - (step + 1) / steps)
        scaled = [t.with_sigma(s) for t, s in zip(terms, sigmas.tolist(), strict=True)]
        near = inliers.with_pairs(scaled)
        T = near.minimize(T, at.scales, tolerance=_COARSE).T_camera_lidar
    kept = [t.without_outliers(T, s) for t, s in zip(scaled, sigmas.tolist(), strict=True)]
    joined = inliers.with_pairs(kept)
    goes_on = inliers.config.preset == "auto"  # to the optimum of the error model
    tolerance = _COARSE if goes_on else RELATIVE_TOLERANCE
    return joined, joined.minimize(T, at.scales, tolerance=tolerance)


def place_pairs(terms: Sequence[PairTerm], T_camera_lidar: Mapping[str, Array]) -> Places:
    """Per pair, (4, 4) T_camera_lidar of both cameras by its terms alone, the first held nearby."""
    covariance = np.diag(pose_sigmas(rotation_rad=_HELD_RAD, translation_m=_HELD_M) ** 2)
    found = {}
    for pair in dict.fromkeys(term.pair for term in terms):
        a, b = (name for name in T_camera_lidar if name in pair)
        own = [term for term in terms if term.pair == pair]
        found[pair], _ = fit_pair((a, b), own, T_camera_lidar, covariance)
    return found


def pair_sigmas() -> Array:
    """(6,) of a relative pose from images: of lenses and surfaces, which all frames share."""
    sizes = error_components()
    return pose_sigmas(rotation_rad=sizes.pair_rotation_rad, translation_m=sizes.pair_translation_m)


def fit_pair(
    names: tuple[str, str],
    terms: Sequence[PairTerm],
    start: Mapping[str, Array],
    covariance_a: Array,
    *,
    near: Mapping[str, Array] | None = None,
) -> tuple[dict[str, Array], Array]:
    """Both cameras of a pair by what they see in common, the first held near its start.

    By Gauss-Newton steps; before each the terms' sigmas are those of their residuals, until these
    stand.

    Args:
        names: A and B.
        terms: of this pair.
        start: (4, 4) T_camera_lidar of both.
        covariance_a: (6, 6) of the start of A, of xi in T_camera_lidar = exp(xi) start.
        near: where both are about; None: at the start.

    Returns:
        (4, 4) T_camera_lidar of both; their (12, 12) covariance, if features of a frame err as
        usual.
    """
    T, held = np.stack([(near or start)[name] for name in names]), np.linalg.pinv(covariance_a)
    prior, rows = np.zeros((12, 12)), [rows_of_pair(names, term) for term in terms]
    prior[:6, :6], sigmas, stands = held, np.zeros(len(terms)), False
    reach, slope = 1.0, 0.0
    step: Array = np.zeros(12)
    for number in range(_MAX_STEPS):
        now, data, gradient = dict(zip(names, T, strict=True)), np.zeros((12, 12)), np.zeros(12)
        if not stands:
            before, sigmas = sigmas, np.array([term.sigma_px(now) for term in terms])
            stands = number > _MOST or bool((np.abs(sigmas - before) <= _SETTLED * sigmas).all())
            blocks = [t.scaled(s) for t, s in zip(terms, sigmas.tolist(), strict=True)]
        poses = dict(zip(names, map(to_T_lidar_camera, T), strict=True))
        for own, term, block in zip(rows, terms, blocks, strict=True):
            sums = block.sums(poses[term.a], poses[term.b])
            data[own[:, None], own] += sums.hessian
            gradient[own] += sums.gradient
        gradient[:6] += held @ local_coordinates(start[names[0]], invert(T[:1]))[0]
        hessian = prior + data
        reach = lengthen(reach, float(gradient @ step) / slope) if slope else 1.0
        step = -np.asarray(
            np.linalg.solve(hessian + DAMPING * np.diag(np.diag(hessian)), gradient), np.float64
        )
        step *= min(reach, _MAX_STEP / np.abs(step).max())
        slope = float(gradient @ step) if stands else 0.0
        T = retract_all(T, step.reshape(2, 6))
        if np.abs(step).max() < _CONVERGED:
            break
    covariance = np.linalg.pinv(prior + data / usual_excess(terms), hermitian=True)
    return dict(zip(names, T, strict=True)), np.asarray(covariance)


@dataclass(frozen=True, eq=False)
class PairFit:
    """Where images place camera B relative to camera A.

    Attributes:
        a, b: their names.
        terms: features of A with surfaces in B, and of B in A.
        T_camera_lidar: (4, 4) of both, A held near a calibration.
        covariance: (6, 6) of xi in T_b_a = exp(xi) fit, in the axes of B.
    """

    a: str
    b: str
    terms: tuple[PairTerm, ...]
    T_camera_lidar: Mapping[str, Array]
    covariance: Array

    @property
    def T_b_a(self) -> Array:
        """(4, 4)."""
        return relative_transform(self.T_camera_lidar[self.b], self.T_camera_lidar[self.a])

    @property
    def features(self) -> int:
        """How many, on surfaces."""
        return sum(len(term.frame) for term in self.terms)


def fit_pairs(
    terms: Sequence[PairTerm], T_camera_lidar: Mapping[str, Array], held: Array, alone: Places
) -> list[PairFit]:
    """Each pair of cameras with enough features on surfaces, by these.

    Args:
        terms: with the surfaces at the calibration.
        T_camera_lidar: (4, 4) the calibration, that A is held near.
        held: (N, 6, 6) covariances by which cameras are held.
        alone: by :func:`place_pairs`.
    """
    fits, cameras = [], list(T_camera_lidar)
    for pair, near in alone.items():
        own = tuple(term for term in terms if term.pair == pair and term.block.axes > 1)
        if own:
            a, b = (name for name in cameras if name in pair)
            of_a = held[cameras.index(a)]
            T, both = fit_pair((a, b), own, T_camera_lidar, of_a, near=near)
            covariance = relative_covariance(both, 0, 1, relative_transform(T[b], T[a]))
            fits.append(PairFit(a, b, own, T, covariance + np.diag(pair_sigmas() ** 2)))
    return fits


def shared_variance_ratio(
    T_camera_lidar: Mapping[str, Array], covariance: Array, fits: Sequence[PairFit]
) -> float:
    """Variance of the shared error over its usual one, by what cameras see in common; at least 1.

    The correspondences place each camera by itself; images place them relative to each other, much
    better. The difference, over pairs that span each group of tied cameras, is chi-squared
    distributed if the covariances are right, with six degrees of freedom per pair. The usual size
    counts as six of them. It is never taken for less than usual: what displaces all cameras alike
    is not seen between them.

    Args:
        T_camera_lidar: (4, 4) of all cameras, by their correspondences.
        covariance: (6 N, 6 N) of these.
        fits: where the images place them.
    """
    cameras, chosen = list(T_camera_lidar), _spanning(fits)
    if not chosen:
        return 1.0
    apart, to_pairs, of_images = [], [], np.zeros((6 * len(chosen), 6 * len(chosen)))
    for number, fit in enumerate(chosen):
        T_b_a = relative_transform(T_camera_lidar[fit.b], T_camera_lidar[fit.a])
        apart.append(twist_between(T_b_a, fit.T_b_a))
        to_pair = np.zeros((6, len(covariance)))
        to_pair[:, pose_rows(cameras.index(fit.a))] = -gtsam.Pose3(T_b_a).AdjointMap()
        to_pair[:, pose_rows(cameras.index(fit.b))] = np.eye(6)
        to_pairs.append(to_pair)
        of_images[pose_rows(number), pose_rows(number)] = fit.covariance
    jacobian, step = np.concatenate(to_pairs), np.concatenate(apart)
    whole = jacobian @ covariance @ jacobian.T + of_images
    chi_squared = float(step @ np.linalg.solve(whole, step))
    usual_dof = error_components().shared_dof
    return max(1.0, (usual_dof + chi_squared) / (usual_dof + len(step)))


def _spanning(fits: Sequence[PairFit]) -> list[PairFit]:
    """Pairs that tie each group of cameras once: those with the most features first."""
    body: dict[str, str] = {}
    chosen = []
    for fit in sorted(fits, key=lambda fit: -fit.features):
        one, two = (body.setdefault(name, name) for name in (fit.a, fit.b))
        if one != two and fit.features >= ENOUGH_SURFACES:
            chosen.append(fit)
            body = {name: one if of == two else of for name, of in body.items()}
    return chosen

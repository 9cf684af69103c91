"""What cameras see in common: the last step of the joint solve, and a fit of one pair alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.objective import pose_key
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.config import Config
from calibgraph.model.findings import error_components
from calibgraph.model.geometry import (
    pose_rows,
    relative_covariance,
    relative_transform,
    to_T_lidar_camera,
)
from calibgraph.model.rig import Rig
from calibgraph.solver.camera_pairs import PairTerm, pair_graph, pair_terms, usual_excess
from calibgraph.solver.curvature import FittedObjective
from calibgraph.solver.objective import Objective
from calibgraph.solver.optimizer import Optimum, optimize
from factors import EpipolarBlock, pose_sigmas

_NARROWINGS = 4  # steps from the spread at the estimate to the least one
_PAIR_RESCALINGS = 6
_HELD_RAD, _HELD_M = np.radians(1.0), 0.2  # of the first camera, while its pair is fitted alone


def refine_with_pairs(
    at: FittedObjective, matches: CameraMatches
) -> tuple[Objective, Optimum] | None:
    """Minimize again with the terms of camera pairs, their sigmas narrowed step by step; gate; fit.

    Args:
        at: the minimum without pairs.
        matches: with surfaces, taken near the optimum.

    Returns:
        The objective with the pairs' inliers, and its minimum; None where no pair of cameras has
        enough in common, or the correspondences are not used.
    """
    inliers, T = at.objective, at.T_camera_lidar
    rig = inliers.rig.moved_to(T)
    terms = pair_terms(rig, matches, inliers.config)
    if not terms or not inliers.uses_correspondences:
        return None
    least = _least_sigmas(terms, T)
    for step in range(_NARROWINGS):
        now = np.array([term.sigma_px(T) for term in terms])
        sigmas = least * np.maximum(now / least, 1.0) ** (1.0 - (step + 1) / _NARROWINGS)
        scaled = tuple(t.with_sigma(s) for t, s in zip(terms, sigmas.tolist(), strict=True))
        T = replace(inliers, pairs=scaled).minimize(T, at.scales).T_camera_lidar
    kept = tuple(t.without_outliers(T, s) for t, s in zip(scaled, sigmas.tolist(), strict=True))
    joined = replace(inliers, pairs=kept)
    return joined, joined.minimize(T, at.scales)


def _least_sigmas(terms: Sequence[PairTerm], T_camera_lidar: Mapping[str, Array]) -> Array:
    """(n,) spread of each term's residuals where its pair's terms alone place the cameras.

    At an estimate that is wrong, residuals are large, and so would be the spread by which they are
    weighed: the pair could not correct it.
    """
    covariance = np.diag(pose_sigmas(rotation_rad=_HELD_RAD, translation_m=_HELD_M) ** 2)
    found: dict[frozenset[str], dict[str, Array]] = {}
    for term in terms:
        pair = frozenset((term.a, term.b))
        if pair not in found:
            own = [other for other in terms if {other.a, other.b} == pair]
            found[pair] = fit_pair((term.a, term.b), own, T_camera_lidar, covariance)
    return np.array([term.sigma_px(found[frozenset((term.a, term.b))]) for term in terms])


def pair_sigmas() -> Array:
    """(6,) of a relative pose from images: of lenses and surfaces, which all frames share."""
    sizes = error_components()
    return pose_sigmas(rotation_rad=sizes.pair_rotation_rad, translation_m=sizes.pair_translation_m)


def fit_pair(
    names: tuple[str, str],
    terms: Sequence[PairTerm],
    start: Mapping[str, Array],
    covariance_a: Array,
) -> dict[str, Array]:
    """Both cameras of a pair by what they see in common, the first held near its start.

    Args:
        names: A and B.
        terms: of this pair.
        start: (4, 4) T_camera_lidar of both.
        covariance_a: (6, 6) of the start of A, of xi in T_camera_lidar = exp(xi) start.

    Returns:
        (4, 4) T_camera_lidar of both.
    """
    keys = {name: pose_key(names, name) for name in names}
    # T_camera_lidar = exp(xi) start is T_lidar_camera = start exp(-xi): the same covariance.
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance_a)
    held = gtsam.PriorFactorPose3(keys[names[0]], to_T_lidar_camera(start[names[0]]), noise)
    T = {name: start[name] for name in names}
    for _ in range(_PAIR_RESCALINGS):
        graph = pair_graph([term.with_sigma(term.sigma_px(T)) for term in terms], keys)
        graph.add(held)
        T = optimize(graph, names, T).T_camera_lidar
    return T


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


def fit_pairs(rig: Rig, matches: CameraMatches, config: Config, held: Array) -> list[PairFit]:
    """Each pair of cameras with enough features on surfaces, in the table's order.

    Args:
        rig: at the calibration that A is held near.
        matches: with the surfaces there.
        config: the loss.
        held: (N, 6, 6) covariances by which cameras are held, in the rig's order.
    """
    fits, cameras = [], list(rig.cameras)
    for a, b in matches.pairs():
        terms = tuple(
            term
            for term in pair_terms(rig, matches.of_pair(a, b), config)
            if not isinstance(term.block, EpipolarBlock)
        )
        if terms:
            of_a = held[cameras.index(a)]
            T = fit_pair((a, b), terms, rig.T_camera_lidar, of_a)
            both = covariance_of_fit((a, b), terms, T, of_a)
            own = relative_covariance(both, 0, 1, relative_transform(T[b], T[a]))
            fits.append(PairFit(a, b, terms, T, own + np.diag(pair_sigmas() ** 2)))
    return fits


def covariance_of_fit(
    names: tuple[str, str],
    terms: Sequence[PairTerm],
    T_camera_lidar: Mapping[str, Array],
    covariance_a: Array,
) -> Array:
    """(12, 12) covariance of A and B after ``fit_pair``, if features of a frame err as usual.

    Args:
        names: A and B.
        terms: of this pair.
        T_camera_lidar: (4, 4) of both, as fitted.
        covariance_a: (6, 6) by which A was held.
    """
    hessian = np.zeros((12, 12))
    hessian[:6, :6] = np.linalg.pinv(covariance_a, hermitian=True)
    excess = usual_excess(terms)
    for term in terms:
        rows = np.r_[tuple(pose_rows(names.index(name)) for name in (term.a, term.b))]
        scaled = term.with_sigma(term.sigma_px(T_camera_lidar))
        hessian[np.ix_(rows, rows)] += scaled.sums(T_camera_lidar).hessian / excess
    return np.asarray(np.linalg.pinv(hessian, hermitian=True))

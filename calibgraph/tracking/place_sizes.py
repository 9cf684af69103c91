"""The sizes of the error model that sums over places show: REML, as in a batch.

See ``calibgraph.solver.variance_components``. Everything is linear here, so the displacements of
places and their covariances follow from those of the cameras by formula.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibgraph.solver.variance_components import (
    Component,
    Evidence,
    VarianceRatios,
    ratios_by_evidence,
)
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.place_errors import Information, PlaceTerms, SharedErrors
from calibgraph.tracking.place_sums import PlaceSums

Array = NDArray[np.float64]


def sizes_shown(
    sums: PlaceSums,
    terms: PlaceTerms,
    errors: SharedErrors,
    of_poses: Information,
    present: VarianceRatios,
) -> VarianceRatios:
    """The sizes that sums over places show.

    Args:
        sums: of all frames.
        terms: of each place.
        errors: of the present sizes.
        of_poses: priors and measured relative poses.
        present: sizes.
    """
    matched = terms.information.sum(np.ones(len(sums.names), dtype=np.bool_))
    n = len(errors.to_cameras)
    step, covariance = _shared_poses(matched, errors, of_poses)
    # y, the cameras as the matches show them: m - A o.
    flat = errors.to_cameras.reshape(6 * n, 6)
    to_seen = np.hstack([np.zeros((6 * n, 6 * n)), np.eye(6 * n), -flat])
    seen, spread = to_seen @ step, to_seen @ covariance @ to_seen.T
    clouds, cameras = _at_places(terms, seen, spread, sums.frames > 0)
    evidence: dict[Component, Evidence] = {
        "shared": _of_all(step, covariance, errors),
        "cloud": clouds,
        "cameras": cameras,
    }
    places = int(np.count_nonzero(sums.frames[1:].any(axis=1)) + sums.places[0].max())
    places -= 0 if sums.frames[0].any() else 1
    return ratios_by_evidence(evidence, places=places, present=present)


def _shared_poses(
    matched: Information, errors: SharedErrors, of_poses: Information
) -> tuple[Array, Array]:
    """The step and covariance of x, m (6 n each) and o: see ``calibgraph.graph.latent_poses``."""
    n = len(errors.to_cameras)
    flat, weak = errors.to_cameras.reshape(6 * n, 6), np.kron(np.eye(n), WEAK)
    cameras, x, m = np.linalg.inv(errors.cameras), slice(6 * n), slice(6 * n, 12 * n)
    hessian, vector = np.zeros((12 * n + 6, 12 * n + 6)), np.zeros(12 * n + 6)
    hessian[x, x] = of_poses.matrix + cameras + weak
    hessian[m, m] = matched.matrix + cameras
    hessian[x, m] = hessian[m, x] = -cameras
    hessian[m, 12 * n :] = -matched.matrix @ flat
    hessian[12 * n :, m] = hessian[m, 12 * n :].T
    hessian[12 * n :, 12 * n :] = np.linalg.inv(errors.cloud) + flat.T @ matched.matrix @ flat
    vector[x], vector[m], vector[12 * n :] = of_poses.vector, matched.vector, 0.0
    vector[12 * n :] = -flat.T @ matched.vector
    vector[x] -= cameras @ errors.offset
    vector[m] += cameras @ errors.offset
    covariance = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
    return covariance @ vector, covariance


def _of_all(step: Array, covariance: Array, errors: SharedErrors) -> Evidence:
    """Of what all frames share."""
    n = len(errors.to_cameras)
    apart = np.hstack([-np.eye(6 * n), np.eye(6 * n), np.zeros((6 * n, 6))])
    inverse = np.zeros((6 * n + 6, 6 * n + 6))
    inverse[: 6 * n, : 6 * n] = np.linalg.inv(errors.cameras)
    inverse[6 * n :, 6 * n :] = np.linalg.inv(errors.cloud)
    to_errors = np.vstack([apart, np.eye(12 * n + 6)[12 * n :]])
    error, known = to_errors @ step, to_errors @ covariance @ to_errors.T
    error[: 6 * n] -= errors.offset
    return Evidence(float(error @ inverse @ error), 6 * n + 6 - float((inverse * known).sum()))


def _at_places(
    terms: PlaceTerms, seen: Array, spread: Array, has_frames: NDArray[np.bool_]
) -> tuple[Evidence, Evidence]:
    """Of the cloud at places, and of the cameras there.

    Args:
        terms: of each place.
        seen: (6 n,) step of the cameras as matches show them everywhere.
        spread: (6 n, 6 n) its covariance.
        has_frames: (P, n).
    """
    P, n = has_frames.shape
    A, own, left = terms.to_cameras, terms.own, terms.left
    pull = terms.vector - (own @ seen.reshape(n, 6, 1))[..., 0]
    cloud = (left @ np.einsum("nji,pnj->pi", A, pull)[..., None])[..., 0]
    gain = -left @ (own @ A).reshape(P, 6 * n, 6).swapaxes(1, 2)
    inverse = np.linalg.inv(terms.cloud)
    known = left + gain @ spread @ gain.swapaxes(1, 2)
    used = has_frames.any(axis=1)
    of_cloud = Evidence(
        float(np.einsum("pi,pij,pj->p", cloud, inverse, cloud)[used].sum()),
        float((6.0 - (inverse * known).sum(axis=(1, 2)))[used].sum()),
    )
    by_root = np.linalg.inv(terms.root)
    excess = by_root.swapaxes(2, 3) @ terms.excess @ by_root
    rest = pull - (own @ (A @ cloud[:, None, :, None]))[..., 0]
    squared = np.einsum("pni,pnij,pnj->pn", rest, excess, rest)
    to_place = (A @ gain[:, None]).reshape(P, n, 6, 6 * n)
    to_place += np.eye(6 * n).reshape(n, 6, 6 * n)
    known = to_place @ spread @ to_place.swapaxes(2, 3) + A @ left[:, None] @ A.swapaxes(1, 2)
    learnt = excess @ own
    free = np.trace(learnt, axis1=2, axis2=3) - (own @ learnt * known).sum(axis=(2, 3))
    return of_cloud, Evidence(float(squared[has_frames].sum()), float(free[has_frames].sum()))

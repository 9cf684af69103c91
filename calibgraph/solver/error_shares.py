"""How much each source of error adds to the variance of a camera's pose.

The estimate is linear in the errors near its minimum: an error e of a factor with Jacobian J and
information M moves it by C J^T M e, where C is the covariance of all poses. The errors of different
factors are independent, so that their variances C J^T M S M J C, with S the covariance of e, add up
to C. The matches have the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.error_sources import (
    COMMON,
    ELEVATION,
    MATCHES,
    MOTION,
    PAIRS,
    PLACES,
    PRIORS,
    STRETCH,
    TIMES,
    ErrorSources,
)
from calibgraph.model.geometry import pose_rows
from calibgraph.solver.curvature import pose_hessian
from calibgraph.solver.error_model import ErrorFit
from calibgraph.solver.hierarchy_poses import placed_edges, shared_edges

Array = NDArray[np.float64]
Variances = dict[str, Array]

_BENDS = ELEVATION, STRETCH, MOTION
_NOTHING = 1e-9  # share of a variance


def sources_of_error(
    total: Array, parts: Variances, forecast: Mapping[int, Array], camera: int
) -> ErrorSources:
    """The sources of one camera's error bar.

    Args:
        total: (6 N,) variances of all cameras.
        parts: per source, (6 N,) of its part; the matches have the rest.
        forecast: by how many times more frames and places there are, (6 N,) variances.
        camera: its number.
    """
    matches = np.maximum(total - sum(parts.values(), np.zeros(len(total))), 0.0)
    variances, rows = {MATCHES: matches, **parts}, pose_rows(camera)
    rotation, translation = (
        _shares(variances, first + int(np.argmax(total[first : first + 3])))
        for first in (rows.start, rows.start + 3)
    )
    later = {times: _error_bar(variance[rows]) for times, variance in forecast.items()}
    return ErrorSources(*_error_bar(total[rows]), rotation, translation, later)


def _shares(variances: Variances, axis: int) -> dict[str, float]:
    """Of the variance of one axis, without sources that add nothing but rounding."""
    whole = float(sum(variance[axis] for variance in variances.values()))
    shares = {name: float(variance[axis]) / whole for name, variance in variances.items()}
    return {name: share for name, share in shares.items() if share > _NOTHING}


def _error_bar(variances: Array) -> tuple[float, float]:
    """Standard deviation of rotation [deg] and translation [cm] along the worst axes, of (6,)."""
    sigmas = np.sqrt(variances)
    return float(np.degrees(sigmas[:3].max())), 100 * float(sigmas[3:].max())


def predict_variances(errors: ErrorFit) -> dict[int, Array]:
    """(6 N,) of all cameras, if such frames at such places were recorded several times as often.

    What places show adds up, what they all share remains.
    """
    model, fit = errors.model, errors.fit
    edges, free = shared_edges(model, fit.poses), len(fit.shared_covariance)
    cameras, parts = 6 * len(model.cameras), model.components
    jacobian, known = edges.jacobian[:, :free], np.zeros((free, free))
    known[:cameras, :cameras] = _pose_graph_hessian(errors)
    of_places = fit.equations.reduced[0] - jacobian.T @ edges.information @ jacobian - known
    found = {}
    for times in TIMES:
        more = replace(parts, bend_information=times * parts.bend_information)
        shared = jacobian.T @ more.shared_information @ jacobian
        columns = np.linalg.solve(times * of_places + shared + known, np.eye(free, cameras))
        found[times] = np.diag(columns)
    return found


def _pose_graph_hessian(errors: ErrorFit) -> Array:
    """(6 N, 6 N) of priors and measured relative poses."""
    model = errors.model
    T_camera_lidar = errors.fit.T_camera_lidar(model)
    return pose_hessian(model.pose_graph, list(model.cameras), T_camera_lidar)


def variances_by_source(errors: ErrorFit) -> Variances:
    """Per source but the matches, (6 N,) of its part of the variances of all cameras."""
    return {**_of_shared(errors), **_of_places(errors)}


def _of_shared(errors: ErrorFit) -> Variances:
    """What all places share: the cloud, its bends, matches and pairs of a camera; the priors."""
    model, fit = errors.model, errors.fit
    parts, cameras = model.components, 6 * len(model.cameras)
    edges, free = shared_edges(model, fit.poses), len(fit.shared_covariance)
    moved = fit.shared_covariance[:cameras] @ edges.jacobian[:, :free].T @ edges.information
    by_bend = moved[:, 6:] @ parts.all_bends @ parts.bend_covariance
    return {
        COMMON: _variance(moved[:, :6], parts.cloud)
        + _of_each(moved[:, 6 : 6 + cameras], parts.camera),
        PAIRS: _of_each(moved[:, 6 + cameras :], parts.pairs),
        **dict(zip(_BENDS, (by_bend**2 / parts.bend_size).T, strict=True)),
        PRIORS: _variance(fit.covariance, _pose_graph_hessian(errors)),
    }


def _of_places(errors: ErrorFit) -> Variances:
    """What the frames of a place share, beyond the scatter of its frames."""
    model, fit = errors.model, errors.fit
    parts, (P, L) = model.components, fit.distances.shape
    edges, moved = placed_edges(model, fit.poses), fit.shared_covariance[: 6 * len(model.cameras)]
    of_place = -(moved @ fit.place_slope.transpose(0, 2, 1)).reshape(P, -1, L, 6)
    by_place = of_place.transpose(0, 2, 1, 3).reshape(P * L, -1, 6)
    by_shared = moved.reshape(len(moved), -1, 6)[:, edges.first].transpose(1, 0, 2)
    gain = by_shared @ edges.to_first.transpose(0, 2, 1)
    gain = (gain + by_place @ edges.to_second.transpose(0, 2, 1)) @ edges.information
    cloud = np.broadcast_to(parts.cloud_at_place, (P, 1, 6, 6))
    shared = np.concatenate([cloud, parts.at_place - parts.scatter_at_place], axis=1)
    variances = np.einsum("nij,njk,nik->ni", gain, shared.reshape(P * L, 6, 6), gain)
    return {PLACES: edges.weight @ variances}


def _variance(moved: Array, covariance: Array) -> Array:
    """(n,) of (n, k) responses to errors of this (k, k) covariance."""
    return np.asarray(np.einsum("ij,jk,ik->i", moved, covariance, moved))


def _of_each(moved: Array, covariance: Array) -> Array:
    """The same of errors that every camera has by itself."""
    each = moved.reshape(len(moved), -1, 6)
    return np.asarray(np.einsum("icj,jk,ick->i", each, covariance, each))

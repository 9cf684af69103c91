"""How much each source of error adds to the variance of a camera's pose.

Near its optimum the estimate is linear in the errors: an error e of a factor with Jacobian J and
information M = S^-1 moves it by C J^T M e, where C is the covariance of all poses. The errors of
different factors are independent, and their variances C J^T M S M J C add up to C. The matches have
the rest.
"""

from collections.abc import Mapping
from dataclasses import replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import LatentPoseModel, to_ordering
from calibgraph.graph.linear_data import marginal_information
from calibgraph.model.error_sources import (
    COMMON,
    ELEVATION,
    ESTIMATED,
    FLAT,
    LENSES,
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
from calibgraph.solver.elimination import Linearization, join_linear
from calibgraph.solver.error_model import ErrorFit

Variances = dict[str, Array]

_DISTORTIONS = ELEVATION, STRETCH, MOTION
_NOTHING = 1e-8  # share of a variance: rounding of a difference
_DIFFERENCE = 5e-3  # of the log of a variance


def sources_by_camera(
    joint: Array,
    total: Array,
    parts: Variances,
    forecast: Mapping[int, Array],
    *,
    numbers: Mapping[str, int],
) -> dict[str, ErrorSources]:
    """Per camera, the sources of its error bar.

    Args:
        joint: (6 N, 6 N) the reported covariance, which may be wider than that of the matches.
        total: (6 N,) variances by the matches.
        parts: of these, as of :func:`sources_of_error`.
        forecast: likewise.
        numbers: of the cameras.
    """
    flat = np.diag(joint) - total
    forecast = {times: variance + flat / times for times, variance in forecast.items()}
    total, parts = total + flat, {**parts, FLAT: flat}
    return {n: sources_of_error(total, parts, forecast, number) for n, number in numbers.items()}


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

    The information of places is repeated; that of what they all share is not.
    """
    linear = errors.fit.linear
    model, found = linear.model, {}
    for times in TIMES:
        shared = _distorted_repeatedly(linear, times) if model.is_distorted else linear.shared
        found[times] = _variances(model, shared, _repeated(linear.left_by_places, times))
    return found


def _variances(model: LatentPoseModel, *graphs: gtsam.GaussianFactorGraph) -> Array:
    """(6 N,) of the reported poses, by linear factors of what all places share."""
    information = marginal_information(join_linear(*graphs), model.shared_keys, model.reported_keys)
    return np.diag(np.linalg.inv(information))


def _distorted_repeatedly(linear: Linearization, times: int) -> gtsam.GaussianFactorGraph:
    """The linear factors of what all places share; the distortion is shown so many times."""
    parts = linear.model.components
    shown, vector = times * parts.distortion_information, times * parts.distortion_vector
    parts = replace(parts, distortion_information=shown, distortion_vector=vector)
    return replace(linear.model, components=parts).shared_graph.linearize(linear.values)


def _repeated(graph: gtsam.GaussianFactorGraph, times: int) -> gtsam.GaussianFactorGraph:
    """The factors of a graph so many times, added up to one factor."""
    if times == 1:
        return graph
    half, found = _repeated(graph, times // 2), gtsam.GaussianFactorGraph()
    odd = [graph] if times % 2 else []
    found.push_back(gtsam.HessianFactor(join_linear(half, half, *odd)))
    return found


def variances_by_source(errors: ErrorFit) -> Variances:
    """Per source but the matches, (6 N,) of its part of the variances of all cameras."""
    return {**_of_shared(errors.fit.linear), PLACES: _of_places(errors)}


def _of_shared(linear: Linearization) -> Variances:
    """The parts of the factors that act on what all places share.

    A factor with the whitened Jacobian A adds C A^T A C.
    """
    model = linear.model
    keys = model.reported_keys + model.shared_keys[: -len(model.cameras)]
    dims = linear.values.dims()
    sizes = [dims[key] for key in keys]
    ends = dict(zip(keys, np.cumsum(sizes), strict=True))
    hessian = join_linear(linear.shared, linear.left_by_places).hessian(to_ordering(keys))[0]
    covariance = np.linalg.inv(hessian)[: 6 * len(model.cameras)]
    found = dict.fromkeys(
        (COMMON, PAIRS, LENSES, ESTIMATED, *_DISTORTIONS, PRIORS), np.zeros(len(covariance))
    )
    for number in range(linear.shared.size()):
        factor = linear.shared.at(number)
        if isinstance(factor, gtsam.HessianFactor):
            continue  # the residuals of the distortion, which are matches
        letters = {chr(gtsam.symbolChr(key)) for key in factor.keys()}  # noqa: SIM118
        size = {key: sizes[keys.index(key)] for key in factor.keys()}  # noqa: SIM118
        columns = [np.arange(ends[key] - size[key], ends[key]) for key in size]
        moved = covariance[:, np.concatenate(columns)] @ factor.jacobian()[0].T
        if letters == {"d"}:
            for name, part in zip(_DISTORTIONS, (moved**2).T, strict=True):
                found[name] = found[name] + part
            continue
        source = PAIRS if "n" in letters else COMMON if letters & {"m", "o", "y"} else PRIORS
        if "m" not in letters and letters & {"l", "b"}:
            source = ESTIMATED if "l" in letters else LENSES
        found[source] = found[source] + (moved**2).sum(axis=1)
    return found


def _of_places(errors: ErrorFit) -> Array:
    """(6 N,) the part that the frames of a place share, beyond their scatter.

    The derivative of the variances by the log of its covariance, from two differences.
    """
    linear, model = errors.fit.linear, errors.fit.linear.model
    parts, scale = model.components, model.components.robust_scale
    if np.isfinite(scale):
        parts = parts.with_fixed_weights(errors.fit.place_weights(scale))

    def variances(step: float) -> Array:
        factor = float(np.exp(step))
        place = factor * (parts.at_place - parts.scatter_at_place) + parts.scatter_at_place
        other = replace(parts, cloud_at_place=factor * parts.cloud_at_place, at_place=place)
        placed = replace(model, components=other).place_graph.linearize(linear.values)
        every = join_linear(placed, linear.data.graph)
        left = every.eliminatePartialSequential(to_ordering(model.place_keys))[1]
        return _variances(model, linear.shared, left)

    near, far = (
        (variances(step) - variances(-step)) / (2 * step) for step in (_DIFFERENCE, 2 * _DIFFERENCE)
    )
    return np.asarray((4.0 * near - far) / 3.0)

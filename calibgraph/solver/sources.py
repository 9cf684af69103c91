"""How much each source of error adds to the variance of a camera's pose.

Near its optimum the estimate is linear in the errors: an error e of a factor with Jacobian J and
information M = S^-1 moves it by C J^T M e, where C is the covariance of all poses. The errors of
different factors are independent, and their variances C J^T M S M J C add up to C. The matches have
the rest.
"""

from collections.abc import Container

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.variables import DISTORTION
from calibgraph.model.error_sources import (
    COMMON,
    ELEVATION,
    ESTIMATED,
    FLAT,
    LENSES,
    MATCHES,
    MOTION,
    OTHER_LIDARS,
    PAIRS,
    PLACES,
    PRIORS,
    STRETCH,
    TIMES,
    ErrorSources,
)
from calibgraph.model.geometry import pose_rows
from calibgraph.solver.places import ErrorFit, invert_scaled

Variances = dict[str, Array]

_DISTORTIONS = ELEVATION, STRETCH, MOTION
_NOTHING = 1e-8  # share of a variance: rounding of a difference


def error_sources(
    errors: ErrorFit, joint: Array, outside: tuple[Array, Array], without: Container[str] = ()
) -> dict[str, ErrorSources]:
    """Per camera, the sources of its error bar, the matches as those of the rest.

    Args:
        errors: the error model at the estimate.
        joint: (6 N, 6 N) the reported covariance, which may be wider than that of the matches.
        outside: (6 N, k) columns of it by the unknown motion of the vehicle, and by the errors of
            the poses of other LiDARs.
        without: cameras that have no error bar.
    """
    total, found = np.diag(joint), {}
    swept, of_lidars = ((columns**2).sum(axis=1) for columns in outside)
    fixed = swept + of_lidars
    flat = total - fixed - np.diag(errors.covariance)
    parts = {**variances_by_source(errors), FLAT: flat, OTHER_LIDARS: of_lidars}
    parts[MOTION] = parts[MOTION] + swept
    rest = np.maximum(total - np.sum([*parts.values()], axis=0), 0.0)
    variances, forecast = {MATCHES: rest, **parts}, predict_variances(errors)
    for number, name in enumerate(errors.model.cameras):
        if name not in without:
            rows = pose_rows(number)
            rotation, translation = (
                _shares(variances, first + int(np.argmax(total[first : first + 3])))
                for first in (rows.start, rows.start + 3)
            )
            later = {k: _error_bar((own + fixed + flat / k)[rows]) for k, own in forecast.items()}
            found[name] = ErrorSources(*_error_bar(total[rows]), rotation, translation, later)
    return found


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

    The information of places is repeated, and so are the residuals that show the distortion; that
    of what they all share is not.
    """
    linear, rows, found = errors.linear, errors.rows, {}
    for times in TIMES:
        whole = linear.hessian(times)
        if linear.model.is_distorted:
            own = linear.model.columns[DISTORTION]
            more = (times - 1) * linear.model.components.distortion_information
            whole[np.ix_(own, own)] += more
        found[times] = np.diag(rows @ invert_scaled(whole) @ rows.T + errors.by_lenses)
    return found


def variances_by_source(errors: ErrorFit) -> Variances:
    """Per source but the matches, (6 N,) of its part of the variances of all cameras."""
    lenses = np.diag(errors.by_lenses)
    return {**_of_shared(errors), LENSES: lenses, PLACES: _of_places(errors)}


def _of_shared(fit: ErrorFit) -> Variances:
    """The parts of the factors that act on what all places share.

    A factor with the whitened Jacobian A adds C A^T A C.
    """
    linear, factors = fit.linear, fit.linear.shared_factors
    covariance = fit.rows @ linear.joint_covariance
    found = dict.fromkeys(
        (COMMON, PAIRS, ESTIMATED, *_DISTORTIONS, PRIORS), np.zeros(len(covariance))
    )
    for number in range(factors.size()):
        factor = factors.at(number)
        if isinstance(factor, gtsam.HessianFactor):
            continue  # the residuals of the distortion, which are matches
        keys = [*factor.keys()]  # noqa: SIM118
        letters = {chr(gtsam.symbolChr(key)) for key in keys}
        moved = covariance[:, linear.model.columns_of(keys)] @ factor.jacobian()[0].T
        if letters == {"d"}:
            for name, part in zip(_DISTORTIONS, (moved**2).T, strict=True):
                found[name] = found[name] + part
            continue
        source = PAIRS if "n" in letters else COMMON if letters & {"m", "o"} else PRIORS
        if "m" not in letters and "l" in letters:
            source = ESTIMATED
        found[source] = found[source] + (moved**2).sum(axis=1)
    return found


def _of_places(fit: ErrorFit) -> Array:
    """(6 N,) the part that the frames of a place share, beyond their scatter."""
    linear, model, parts = fit.linear, fit.linear.model, fit.linear.model.components
    across = fit.rows @ linear.joint_covariance[:, : model.touched]
    turn, shared = linear.ties.turn[1:], parts.at_place - parts.scatter_at_place
    part = turn @ shared.swapaxes(0, 1)[model.matched] @ turn.swapaxes(-1, -2)
    of_cloud = linear.places.cloud.variances_by(linear.ties.covariance[0], across)
    return of_cloud + linear.places.cameras.variances_by(part, across)

"""Lenses and clocks as a result reports them: their parameters, in the units that people use."""

from __future__ import annotations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.lens import LensVariable
from calibgraph.graph.variables import lens_key
from calibgraph.model.lens import LensEstimate
from calibgraph.solver.places import ErrorFit
from factors.free_lens import FOCAL, OFFSET, READOUT

_DIRECTIONS = "pitch", "yaw", "roll", "x", "y", "z"
_UNITS = {FOCAL: "px", "centre_x": "px", "centre_y": "px", OFFSET: "s", READOUT: "s"}


def lens_estimates(fit: ErrorFit) -> dict[str, tuple[LensEstimate, ...]]:
    """Per camera whose lens is free, its parameters with their marginal."""
    model, found = fit.model, {}
    for number, term in model.lenses.items():
        own = [lens_key(number), model.reported_keys[number]]
        values = fit.linear.shared.atVector(own[0])
        estimates = estimates_of(term.variable, values, fit.linear.covariance_of(own))
        found[model.cameras[number]] = estimates
    return found


def lens_covariances(fit: ErrorFit) -> dict[str, Array]:
    """Per camera whose lens is free, the (6 + k, 6 + k) joint marginal of pose, lens and clock.

    Of xi in T_camera_lidar = exp(xi) estimate, then of the parameters in the order and the units of
    :func:`lens_estimates`.
    """
    model, found = fit.model, {}
    for number, term in model.lenses.items():
        joint = fit.linear.covariance_of([model.reported_keys[number], lens_key(number)])
        units = [_unit(term.variable, row) for row in range(len(term.variable.free))]
        scale = np.array([-1.0] * 6 + units)  # of T_lidar_camera the tangent is -xi
        found[model.cameras[number]] = joint * np.outer(scale, scale)
    return found


def estimates_of(lens: LensVariable, values: Array, covariance: Array) -> tuple[LensEstimate, ...]:
    """The parameters of a lens, by its (k,) values and their (k + 6, k + 6) joint with the pose."""
    sigmas = np.sqrt(np.diag(covariance))
    with_pose = np.abs(covariance / np.outer(sigmas, sigmas))[:, len(values) :]
    rows = range(len(values))
    return tuple(_estimate(lens, row, values, (sigmas, with_pose)) for row in rows)


def _estimate(
    lens: LensVariable, row: int, values: Array, marginal: tuple[Array, Array]
) -> LensEstimate:
    """One parameter, with standard deviation and correlation with the pose of its camera."""
    name, unit = lens.free.parameters[row], _unit(lens, row)
    before, after = (_in_its_unit(lens, name, v) for v in (np.zeros(len(values)), values))
    sigmas, correlation = marginal
    most = int(np.argmax(correlation[row]))
    return LensEstimate(
        name=name,
        unit=_UNITS.get(name, ""),
        value=after,
        sigma=float(sigmas[row] * unit),
        prior=before,
        prior_sigma=float(unit),
        direction=_DIRECTIONS[most],
        correlation=float(correlation[row, most]),
    )


def _unit(lens: LensVariable, row: int) -> float:
    """The prior standard deviation of a parameter, in its unit."""
    name, step = lens.free.parameters[row], lens.free.sigmas[row]
    of_rig = _in_its_unit(lens, name, np.zeros(len(lens.free)))
    return step * of_rig if name == FOCAL else step


def _in_its_unit(lens: LensVariable, name: str, values: Array) -> float:
    """A parameter at some values, as people state it."""
    camera, clock = lens.put_into(lens.camera, values), lens.free.clock_at(values)
    k = camera.intrinsics_px
    known = {
        OFFSET: clock.offset_s,
        READOUT: clock.readout_s,
        FOCAL: float(np.sqrt(k.fx * k.fy)),
        "centre_x": k.cx,
        "centre_y": k.cy,
    }
    return known[name] if name in known else lens.free.coefficient(name, values)

"""Lenses that are estimated together with the extrinsics: their part of the error model.

What matches of one frame share, or of all frames, also looks like another lens. It belongs between
the lens l_c and s_c, as the matches show it: with C the covariance of pose and lens by independent
matches, S that by the scatter of frames, and k the variance that matches are left with in the graph
(``solver.within_place``), its covariance is S - k C, and what places and all matches share.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calibgraph.graph.lens import LensTerm, LensVariable
from calibgraph.graph.variables import lens_key
from calibgraph.model.error_components import error_components
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera
from calibgraph.model.lens_estimate import LensEstimate
from calibgraph.model.rig import Rig
from calibgraph.solver.covariance import with_pseudo_frames
from calibgraph.solver.elimination import LatentPoseFit, marginal_information
from calibgraph.solver.fitted import FittedObjective
from calibgraph.solver.scan_distortion import DistortionEvidence
from calibgraph.solver.within_place import WEAK, WithinPlace
from factors import FreeLensBlock
from factors.free_lens import ASPECT, FOCAL

Array = NDArray[np.float64]
Lenses = Mapping[str, LensVariable]

MATCH_SHARE = 0.01
"""So much of a match's variance is taken to be shared by all: less cannot be told from a wrong
lens."""

_DIRECTIONS = "pitch", "yaw", "roll", "x", "y", "z"
_WEAK_PRIOR = 0.01  # information: a lens that is ten sigmas off is hardly held back
_MOST_STEPS, _MINIMAL = 20, 1e-4  # of Gauss-Newton; decrease of the cost by the last


def put_into(rig: Rig, lenses: Lenses) -> Rig:
    """The rig with lenses at the values of their variables."""
    if not lenses:
        return rig
    moved = {name: of.put_into(rig.cameras[name], of.values) for name, of in lenses.items()}
    return rig.model_copy(update={"cameras": {**rig.cameras, **moved}})


def lens_term(
    lens: LensVariable,
    within: WithinPlace,
    at: FittedObjective,
    matcher: tuple[MatcherFindings, DistortionEvidence | None],
) -> LensTerm:
    """The lens of a camera in the error model.

    Args:
        lens: of the camera.
        within: what its matches of one place share.
        at: the minimum for independent matches, of this camera alone.
        matcher: its error; the quadratics of this camera's matches in the scan distortion.
    """
    findings, evidence = matcher
    ((name, block),) = at.objective.blocks.items()
    free = FreeLensBlock(at.projections[name], lens.free)
    columns, hessian = _at_minimum(free, at.T_camera_lidar[name], lens)
    pulls = (columns[:-1] * (free.loss(columns)[1] * columns[-1])).sum(axis=1)
    gradients = np.add.reduceat(pulls, block.frame_edges[:-1], axis=1).T
    covariance = np.linalg.inv(hessian)
    frames = np.full(len(hessian), float(block.frames))
    usual = 1 + error_components().frame_correlation * (len(block) / block.frames - 1)
    scatter = with_pseudo_frames(gradients.T @ gradients, hessian, frames, usual * hessian)
    by_frames = within.efficiency**2 * (covariance @ scatter @ covariance)[6:, 6:]
    of_matches = MATCH_SHARE * len(block) if any(findings.systematic_sigmas) else 0.0
    shared = within.efficiency * max(findings.place_variance * within.alike, of_matches)
    own = covariance[6:, 6:]
    excess = _positive(by_frames - within.least * own) + shared * own
    sigmas = np.asarray(findings.bend_sigmas)
    bent = np.zeros((len(own), len(sigmas))) if evidence is None else evidence.lens_jacobian
    return LensTerm(lens, excess, bent * sigmas)


def weak_information(lens: LensVariable | None) -> Array:
    """(6 + k, 6 + k) of a pose within sight and a lens, so that few matches have an inverse."""
    return WEAK if lens is None else block_diag(WEAK, _WEAK_PRIOR * np.eye(len(lens.free)))


def _at_minimum(
    free: FreeLensBlock, T_camera_lidar: Array, lens: LensVariable
) -> tuple[Array, Array]:
    """Columns and Hessian of independent matches, where pose and lens fit them best."""
    pose, values, weak = to_T_lidar_camera(T_camera_lidar), lens.values, weak_information(lens)
    for _ in range(_MOST_STEPS):
        sums = free.sums(to_T_camera_lidar(pose), values)
        pull = sums.gradient + weak @ np.concatenate([np.zeros(6), values])
        step = -np.linalg.solve(sums.hessian + weak, pull)
        pose, values = pose.retract(step[:6]), values + step[6:]
        if -step @ pull < _MINIMAL:
            break
    T = to_T_camera_lidar(pose)
    return free.columns(T, values), free.sums(T, values).hessian + weak


def _positive(matrix: Array) -> Array:
    """The positive part of a symmetric matrix."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def moved_lenses(lenses: Lenses, fit: LatentPoseFit | None) -> tuple[Lenses, float]:
    """Lenses where a fit has them, and the largest change of a value in standard deviations."""
    found = {} if fit is None else lens_values(fit)
    moved = {name: lenses[name].moved_to(values) for name, (values, _) in found.items()}
    changes = [abs(v - lenses[n].values) / s for n, (v, s) in found.items()]
    return {**lenses, **moved}, float(np.concatenate([*changes, [0.0]]).max())


def lens_values(fit: LatentPoseFit) -> dict[str, tuple[Array, Array]]:
    """Per camera whose lens is free, its (k,) values and their (k,) standard deviations."""
    covariance = _marginal(fit, [*map(lens_key, fit.linear.model.lenses)])
    found, first = {}, 0
    for number, term in fit.linear.model.lenses.items():
        rows = slice(first, first := first + len(term.variable.free))
        sigmas = np.sqrt(np.diag(covariance)[rows])
        values = fit.linear.values.atVector(lens_key(number))
        found[fit.linear.model.cameras[number]] = values, sigmas
    return found


def lens_estimates(fit: LatentPoseFit) -> dict[str, tuple[LensEstimate, ...]]:
    """Per camera whose lens is free, its parameters with their marginal."""
    model, found = fit.linear.model, {}
    for number, term in model.lenses.items():
        own = [lens_key(number), model.reported_keys[number]]
        covariance = _marginal(fit, own)
        sigmas = np.sqrt(np.diag(covariance))
        values = fit.linear.values.atVector(own[0])
        with_pose = np.abs(covariance / np.outer(sigmas, sigmas))[:, len(values) :]
        found[model.cameras[number]] = tuple(
            _estimate(term.variable, row, values, (sigmas, with_pose)) for row in range(len(values))
        )
    return found


def _estimate(
    lens: LensVariable, row: int, values: Array, marginal: tuple[Array, Array]
) -> LensEstimate:
    """One parameter, with standard deviation and correlation with the pose of its camera."""
    name, step = lens.free.parameters[row], lens.free.sigmas[row]
    before, after = (_in_its_unit(lens, name, v) for v in (np.zeros(len(values)), values))
    unit = step * (before if name in (FOCAL, ASPECT) else 1.0)
    sigmas, correlation = marginal
    most = int(np.argmax(correlation[row]))
    return LensEstimate(
        name=name,
        unit="px" if name == FOCAL or name.startswith("centre") else "",
        value=after,
        sigma=float(sigmas[row] * unit),
        prior=before,
        prior_sigma=float(unit),
        direction=_DIRECTIONS[most],
        correlation=float(correlation[row, most]),
    )


def _in_its_unit(lens: LensVariable, name: str, values: Array) -> float:
    """A parameter at some values, as people state it."""
    camera = lens.put_into(lens.camera, values)
    k = camera.intrinsics_px
    known = {
        FOCAL: float(np.sqrt(k.fx * k.fy)),
        ASPECT: k.fx / k.fy,
        "centre_x": k.cx,
        "centre_y": k.cy,
    }
    return known[name] if name in known else lens.free.coefficient(name, values)


def _marginal(fit: LatentPoseFit, kept: list[int]) -> Array:
    """The covariance of some variables."""
    if not kept:
        return np.zeros((0, 0))
    model = fit.linear.model
    keys = model.place_keys + model.shared_keys
    return np.asarray(np.linalg.inv(marginal_information(fit.linear.graph, keys, kept)))

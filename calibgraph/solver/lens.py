"""Lenses and clocks that are estimated, or that may err: their part of the error model.

What matches of one frame share, or of all frames, also looks like another lens. It belongs between
the lens l_c and s_c, as the matches show it: with C the covariance of pose and lens by independent
matches, S that by the scatter of frames, and k the variance that matches are left with in the graph
(``solver.within_place``), its covariance is S - k C, and what places and all matches share.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from calibgraph.arrays import Array
from calibgraph.graph.components import EXACT
from calibgraph.graph.latent_poses import BlockByPlace
from calibgraph.graph.lens import LensTerm, LensVariable
from calibgraph.graph.variables import lens_key
from calibgraph.model.config import LensPart, Reported
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.geometry import pose_rows, to_T_camera_lidar, to_T_lidar_camera
from calibgraph.model.lens import LensEstimate, LensSigmas
from calibgraph.model.rig import Camera, Rig
from calibgraph.solver.columns import DistortionEvidence
from calibgraph.solver.covariance import FittedObjective, positive_part
from calibgraph.solver.places import ErrorFit
from calibgraph.solver.within_place import WEAK, WithinPlace
from factors import Columns, ProjectionBlock, to_runs
from factors.columns import CENTRE_X, CENTRE_Y, COEFFICIENT_NUMBERS, FOCAL, OFFSET, READOUT

Lenses = Mapping[str, LensVariable]

MATCH_SHARE = 0.01
"""So much of a match's variance is taken to be shared by all: less cannot be told from a wrong
lens."""

_LENS: tuple[LensPart, ...] = "focal", "centre", "distortion"
_MAY_ERR = FOCAL, CENTRE_X, CENTRE_Y, "k1", OFFSET, READOUT
"""Further coefficients of a calibration err together with k1, which stands for all."""
_WEAK_PRIOR = 0.01  # information: a lens that is ten sigmas off is hardly held back
_MOST_STEPS, _MINIMAL = 20, 1e-4  # of Gauss-Newton; decrease of the cost by the last
_SCENES = 0.7, 1.4  # times as far are the things of another recording: so streets scatter
_DEPTHS = 0.5, 1.0, 2.0  # of a scene, over its mean
_SAMPLE, _DIRECTIONS_SEEN = 3000, 500  # at most, of the matches, and of their directions
_NEAREST_M = 0.1  # added to distances, whose logarithms are taken
_TRAVEL = np.diag([0.0, 0.0, 0.1, 10.0, 10.0, 0.0])[2:5]
"""Of a vehicle on a street, standard deviations of turns [rad/s] and speeds [m/s], z upwards."""
_DIRECTIONS = "pitch", "yaw", "roll", "x", "y", "z"
_UNITS = {FOCAL: "px", CENTRE_X: "px", CENTRE_Y: "px", OFFSET: "s", READOUT: "s"}


def put_into(rig: Rig, lenses: Lenses) -> Rig:
    """The rig with lenses at the values of their variables."""
    if not lenses:
        return rig
    moved = {name: of.put_into(rig.cameras[name], of.values) for name, of in lenses.items()}
    return rig.model_copy(update={"cameras": {**rig.cameras, **moved}})


def lens_term(
    lens: LensVariable,
    placed: BlockByPlace,
    within: WithinPlace,
    T_camera_lidar: Array,
    *,
    evidence: DistortionEvidence | None,
    findings: MatcherFindings,
) -> LensTerm:
    """The lens of a camera in the error model.

    Args:
        lens: of the camera.
        placed: its matches.
        within: what its matches of one place share.
        T_camera_lidar: (4, 4) the minimum for independent matches.
        evidence: of the scan distortion, if there is one.
        findings: the matcher's error.
    """
    hessians, gradients = _by_place_at_minimum(lens, placed, T_camera_lidar)
    counts = len(placed.block), len(gradients)
    # In the graph m_c and s_c know of the matches what the poses a_cp of their places leave.
    own = np.linalg.inv(hessians / within.least + weak_information(lens))
    own[:, :6, :6] += within.at_place(findings.place_variance)[placed.places]
    in_graph = np.linalg.inv(np.linalg.inv(own).sum(axis=0))
    hessian = hessians.sum(axis=0) + weak_information(lens)
    covariance = np.linalg.inv(hessian)
    scatter = _allow_for_few_frames(gradients.T @ gradients, hessian, *counts)
    of_matches = MATCH_SHARE * counts[0] if any(findings.systematic_sigmas) else 0.0
    shared = within.efficiency * max(findings.place_variance * within.alike, of_matches)
    whole = within.efficiency**2 * (covariance @ scatter @ covariance) + shared * covariance
    excess = positive_part((whole - in_graph)[6:, 6:])
    bent = np.zeros((len(excess), 0))
    if evidence is not None:
        bent = evidence.lens_jacobian * np.asarray(findings.bend_sigmas)
    follow = -np.linalg.solve(hessian[:6, :6], hessian[:6, 6:])
    return LensTerm(lens, excess, bent, follow)


def _by_place_at_minimum(
    lens: LensVariable, placed: BlockByPlace, T_camera_lidar: Array
) -> tuple[Array, Array]:
    """(p, 6 + k, 6 + k) Hessians of the places with matches, and (f, 6 + k) gradients of frames.

    Where all matches fit best with one pose and lens.
    """
    order = np.argsort(placed.place_of_frame, kind="stable")
    place, edges = placed.place_of_frame[order], np.append(0, placed.count_of_frame[order].cumsum())
    pose, values, weak = to_T_lidar_camera(T_camera_lidar), lens.values, weak_information(lens)
    for _ in range(_MOST_STEPS):
        T = to_T_camera_lidar(pose)[None]
        sums = placed.block.summarize(T, to_runs(edges), lens.free, values)
        pull = sums.gradient.sum(axis=0) + weak @ np.concatenate([np.zeros(6), values])
        step = -np.linalg.solve(sums.hessian.sum(axis=0) + weak, pull)
        if -step @ pull < _MINIMAL:
            break
        pose, values = pose.retract(step[:6]), values + step[6:]
    return np.add.reduceat(sums.hessian, np.searchsorted(place, placed.places)), sums.gradient


def lens_errors(at: FittedObjective) -> Array:
    """(6 N, 6 N) covariance of all poses by what may err of their lenses."""
    found = np.zeros((6 * len(at.cameras), 6 * len(at.cameras)))
    for name, block in at.projections.items():
        lens, T = considered_lens(at.objective.rig.cameras[name], block), at.T_camera_lidar[name]
        block = block.select(np.arange(0, len(block), -(-len(block) // _SAMPLE)))  # noqa: PLW2901
        estimated = at.objective.lenses[name].free.parameters if name in at.objective.lenses else ()
        columns = lens_columns(lens, block, T)
        own = error_by_lens(lens, columns, block, T, of=at.objective.config.of, estimated=estimated)
        if own is not None:
            rows = pose_rows(at.cameras.index(name))
            found[rows, rows] = own
    return found


def travel_errors(at: FittedObjective) -> Array:
    """(6 N, 3) of all poses, by a standard deviation of each unknown motion of the vehicle.

    In the tangents of T_lidar_camera. Where clouds were swept while it drove, and are not
    corrected, every pose makes up for the way between points and pixels: all by the same motion.
    """
    found = np.zeros((len(at.cameras), 6, len(_TRAVEL)))
    for name, block in at.projections.items():
        found[at.cameras.index(name)] = error_by_travel(block, at.T_camera_lidar[name])
    return found.reshape(-1, len(_TRAVEL))


def error_by_travel(block: ProjectionBlock, T_camera_lidar: Array) -> Array:
    """(6, 3) of one pose, as :func:`travel_errors`; zero of points that are as of their pixels."""
    found = np.zeros((6, len(_TRAVEL)))
    if block.motion is None or block.motion[:, :6].any():
        return found  # of one instant, or moved to the time of the pixels
    shift, T = Columns(block.lens, (OFFSET,), (1.0,)), T_camera_lidar[None]
    for column, twist in zip(found.T, _TRAVEL, strict=True):
        of_unit = np.column_stack([np.outer(block.motion[:, 6], twist), np.zeros(len(block))])
        hessian = replace(block, motion=of_unit).summarize(T, None, shift).hessian[0]
        column[:] = np.linalg.solve(hessian[:6, :6] + WEAK, hessian[:6, 6])
    return found


def considered_lens(camera: Camera, block: ProjectionBlock) -> LensVariable:
    """What may err of a lens, as the rig states or as of a calibrated camera.

    And of the clock, where the motion of the LiDAR is known.
    """
    parts: list[LensPart] = [*_LENS]
    if block.motion is not None and block.motion[:, :6].any():
        parts += ["offset", "readout"] if camera.readout_sigma_s else ["offset"]
    return LensVariable.of(camera, parts, LensSigmas.calibrated(camera))


def lens_columns(lens: LensVariable, block: ProjectionBlock, T_camera_lidar: Array) -> Array:
    """(6, 6 + k) rows of the Hessian of some matches, of a pose and its lens: they add up."""
    return block.summarize(T_camera_lidar[None], None, lens.free, lens.values).hessian[0, :6]


def error_by_lens(  # noqa: PLR0913 - of what, where
    lens: LensVariable,
    columns: Array,
    block: ProjectionBlock,
    T_camera_lidar: Array,
    *,
    of: Reported,
    estimated: Collection[str] = (),
) -> Array | None:
    """(6, 6) covariance of a pose by what is not estimated of its lens; None if nothing may err.

    In the tangent of T_lidar_camera. An alignment makes up for a lens, in every recording nearly
    alike: it errs by what other scenes would give. For a clock it makes up by the speed.

    Args:
        lens: by :func:`considered_lens`.
        columns: by :func:`lens_columns`, of all matches.
        block: some of them, at the distances of all.
        T_camera_lidar: (4, 4).
        of: which pose is reported.
        estimated: parameters of the lens that are.
    """
    named = enumerate(lens.free.parameters, start=6)
    rows = [row for row, name in named if name in _MAY_ERR and name not in estimated]
    if not rows:
        return None
    errors = np.linalg.solve(columns[:, :6] + WEAK, columns[:, rows])[None]
    if of == "alignment":
        errors = errors - _in_other_scenes(lens, block, T_camera_lidar, rows)
    covariance = (errors @ errors.transpose(0, 2, 1)).mean(axis=0)
    return np.asarray(covariance + EXACT**2 * np.eye(6))


def _in_other_scenes(
    lens: LensVariable, block: ProjectionBlock, T_camera_lidar: Array, rows: list[int]
) -> Array:
    """(2, 6, m) by how much a pose makes up for a lens in other scenes, for a clock by nothing.

    In each of these there are things in all directions of the matches at all of some distances:
    around theirs, once all nearer and once all farther.
    """
    camera = lens.camera
    points = block.points_lidar_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
    distances = np.linalg.norm(points, axis=1) + _NEAREST_M
    usual_m = np.exp(np.log(distances).mean())
    step = -(-len(points) // _DIRECTIONS_SEEN)
    rays = points[::step] / distances[::step, None]
    pixels, _ = camera.lens.project(rays)
    at_m = usual_m * np.outer(_SCENES, _DEPTHS).ravel()
    points, pixels = (at_m[:, None, None] * rays).reshape(-1, 3), np.tile(pixels, (len(at_m), 1))
    scenes, count = ProjectionBlock(camera.lens, points, pixels), len(_SCENES)
    runs = to_runs(np.arange(count + 1) * (len(points) // count))
    poses = np.tile(np.eye(4), (count, 1, 1))
    hessian = scenes.summarize(poses, runs, lens.free, lens.values).hessian
    return np.asarray(np.linalg.solve(hessian[:, :6, :6] + WEAK, hessian[:, :6, rows]))


def weak_information(lens: LensVariable | None) -> Array:
    """(6 + k, 6 + k) of a pose within sight and a lens, so that few matches have an inverse."""
    return WEAK if lens is None else block_diag(WEAK, _WEAK_PRIOR * np.eye(len(lens.free)))


def _allow_for_few_frames(scatter: Array, hessian: Array, matches: float, frames: float) -> Array:
    """The scatter, with some frames that scatter as usual."""
    known = error_components()
    prior = known.prior_frames / known.pseudo_frames
    usual = 1 + known.frame_correlation * (matches / frames - 1)
    own = scatter + prior * usual * hessian / frames
    return np.asarray(own * frames / (prior + frames - 1))


def moved_lenses(lenses: Lenses, fit: ErrorFit | None) -> tuple[Lenses, float]:
    """Lenses where a fit has them, and the largest change of a value in standard deviations."""
    if fit is None:
        return lenses, 0.0
    moved, largest = {**lenses}, 0.0
    for number in fit.model.lenses:
        name, key = fit.model.cameras[number], lens_key(number)
        values = fit.linear.shared.atVector(key)
        sigmas = np.sqrt(np.diag(fit.linear.covariance_of([key])))
        moved[name] = lenses[name].moved_to(values)
        largest = max(largest, float((abs(values - lenses[name].values) / sigmas).max()))
    return moved, largest


def lens_estimates(fit: ErrorFit) -> tuple[dict[str, tuple[LensEstimate, ...]], dict[str, Array]]:
    """Per camera whose lens is free, its parameters; and the marginal of pose, lens and clock.

    That is (6 + k, 6 + k), of xi in T_camera_lidar = exp(xi) estimate, then of the parameters in
    their order and units.
    """
    model, estimates, joints = fit.model, dict[str, tuple[LensEstimate, ...]](), {}
    for number, term in model.lenses.items():
        own, key, name = pose_rows(number), lens_key(number), model.cameras[number]
        lens, values = term.variable, fit.linear.shared.atVector(key)
        before, after = (_in_units(lens, at) for at in (np.zeros(len(values)), values))
        is_focal = np.equal(lens.free.parameters, FOCAL)
        units = np.where(is_focal, before, 1.0) * lens.free.sigmas
        rows = np.vstack([fit.rows[own], np.eye(model.size)[model.columns[key]]])
        joint = rows @ fit.linear.joint_covariance @ rows.T
        joint[:6, :6] = fit.covariance[own, own]
        scale = np.append(np.full(6, -1.0), units)  # of T_lidar_camera the tangent is -xi
        joints[name] = joint * np.outer(scale, scale)
        sigmas = np.sqrt(np.diag(joints[name]))
        with_pose = np.abs(joints[name] / np.outer(sigmas, sigmas))[6:, :6]
        estimates[name] = tuple(
            LensEstimate(
                name=parameter,
                unit=_UNITS.get(parameter, ""),
                value=float(after[row]),
                sigma=float(sigmas[6 + row]),
                prior=float(before[row]),
                prior_sigma=float(units[row]),
                direction=_DIRECTIONS[int(with_pose[row].argmax())],
                correlation=float(with_pose[row].max()),
            )
            for row, parameter in enumerate(lens.free.parameters)
        )
    return estimates, joints


def _in_units(lens: LensVariable, values: Array) -> Array:
    """The parameters at some values, as people state them."""
    k, clock = lens.put_into(lens.camera, values).intrinsics_px, lens.free.clock_at(values)
    known = {
        OFFSET: clock.offset_s,
        READOUT: clock.readout_s,
        FOCAL: float(np.sqrt(k.fx * k.fy)),
        CENTRE_X: k.cx,
        CENTRE_Y: k.cy,
    }
    numbers, packed = COEFFICIENT_NUMBERS[lens.free.lens.kind], lens.free.at(values).packed
    known |= {name: packed[4 + number] for name, number in numbers.items()}
    return np.array([known[name] for name in lens.free.parameters])

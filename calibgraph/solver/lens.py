"""Lenses that are estimated together with the extrinsics: their part of the error model.

What matches of one frame share, or of all frames, also looks like another lens. It belongs between
the lens l_c and s_c, as the matches show it: with C the covariance of pose and lens by independent
matches, S that by the scatter of frames, and k the variance that matches are left with in the graph
(``solver.within_place``), its covariance is S - k C, and what places and all matches share.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import block_diag

from calibgraph.arrays import Array
from calibgraph.graph.by_place import BlockByPlace
from calibgraph.graph.components import EXACT
from calibgraph.graph.lens import FreeLensByPlace, LensTerm, LensVariable
from calibgraph.graph.variables import lens_key
from calibgraph.model.config import LensPart
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera
from calibgraph.model.lens import LensSigmas
from calibgraph.model.rig import Camera, Rig
from calibgraph.solver.covariance import FittedObjective, positive_part
from calibgraph.solver.places import ErrorFit
from calibgraph.solver.within_place import WEAK, WithinPlace
from factors import FreeLensBlock

Lenses = Mapping[str, LensVariable]

MATCH_SHARE = 0.01
"""So much of a match's variance is taken to be shared by all: less cannot be told from a wrong
lens."""

_LENS: tuple[LensPart, ...] = "focal", "centre", "distortion"
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
    placed: BlockByPlace,
    within: WithinPlace,
    T_camera_lidar: Array,
    *,
    findings: MatcherFindings,
) -> LensTerm:
    """The lens of a camera in the error model, without scan distortion.

    Args:
        lens: of the camera.
        placed: its matches.
        within: what its matches of one place share.
        T_camera_lidar: (4, 4) the minimum for independent matches.
        findings: the matcher's error.
    """
    by_place = FreeLensByPlace(placed, lens.free, 0)
    at = _minimum(by_place, T_camera_lidar, lens)
    hessians = np.array([one.hessian for one in by_place.sums(*at)])
    scatter = _frame_scatter(FreeLensBlock(placed.block, lens.free), placed, at)
    counts = len(placed.block), len(placed.count_of_frame)
    of_poses = within.at_place(findings.place_variance)[placed.places]
    in_graph = np.linalg.inv(
        _information_in_graph(hessians, of_poses, within.least, lens).sum(axis=0)
    )
    hessian = hessians.sum(axis=0) + weak_information(lens)
    covariance = np.linalg.inv(hessian)
    scatter = _allow_for_few_frames(scatter, hessian, *counts)
    of_matches = MATCH_SHARE * counts[0] if any(findings.systematic_sigmas) else 0.0
    shared = within.efficiency * max(findings.place_variance * within.alike, of_matches)
    whole = within.efficiency**2 * (covariance @ scatter @ covariance) + shared * covariance
    excess = positive_part((whole - in_graph)[6:, 6:])
    compensating = np.asarray(-np.linalg.solve(hessian[:6, :6], hessian[:6, 6:]))
    return LensTerm(lens, excess, np.zeros((len(excess), 0)), compensating)


def lens_errors(at: FittedObjective) -> dict[int, Array]:
    """Per number of a camera, (6, 6) covariance of its pose by what is not estimated of its lens.

    Of the pose that fits the matches of a lens which errs as that of a calibrated camera, or as the
    rig states, and of a clock whose errors the rig states; in the tangent of T_lidar_camera. An
    alignment makes up for a lens alike in every recording, but for a clock by the speed.
    """
    found, is_mount = {}, at.objective.config.of == "mount"
    for name, block in at.projections.items():
        camera = at.objective.rig.cameras[name]
        clock = _stated_clock(camera) if is_mount or block.motion is not None else []
        parts = [*(_uncertain_lens(camera) if is_mount else ()), *clock]
        lens = LensVariable.of(camera, parts, LensSigmas.calibrated(camera))
        estimated = at.objective.lenses[name].free.parameters if name in at.objective.lenses else ()
        names = enumerate(lens.free.parameters, start=6)
        rows = [row for row, parameter in names if parameter not in estimated]
        if rows:
            sums = FreeLensBlock(block, lens.free).sums(at.T_camera_lidar[name], lens.values)
            follows = np.linalg.solve(sums.hessian[:6, :6] + WEAK, sums.hessian[:6, rows])
            found[at.cameras.index(name)] = follows @ follows.T + EXACT**2 * np.eye(6)
    return found


def _uncertain_lens(camera: Camera) -> tuple[LensPart, ...]:
    """Of a panorama the format determines the lens."""
    return () if camera.model == "equirectangular" else _LENS


def _stated_clock(camera: Camera) -> list[LensPart]:
    """Of clocks nothing is usual."""
    stated: dict[LensPart, float | None] = {
        "offset": camera.time_offset_sigma_s,
        "readout": camera.readout_sigma_s,
    }
    return [part for part, sigma in stated.items() if sigma]


def _information_in_graph(
    hessians: Array, of_poses: Array, least: float, lens: LensVariable
) -> Array:
    """(p, 6 + k, 6 + k) of m_c and s_c by the matches and the pose of each place.

    Args:
        hessians: (p, 6 + k, 6 + k) of independent matches at each place.
        of_poses: (p, 6, 6) covariance of a_cp about m_c.
        least: variance of the matches.
        lens: of the camera.
    """
    own = np.linalg.inv(hessians / least + weak_information(lens))
    own[:, :6, :6] += of_poses
    return np.asarray(np.linalg.inv(own))


def weak_information(lens: LensVariable | None) -> Array:
    """(6 + k, 6 + k) of a pose within sight and a lens, so that few matches have an inverse."""
    return WEAK if lens is None else block_diag(WEAK, _WEAK_PRIOR * np.eye(len(lens.free)))


def _minimum(
    by_place: FreeLensByPlace, T_camera_lidar: Array, lens: LensVariable
) -> tuple[Array, Array]:
    """(p, 4, 4) pose, the same at each place, and (k,) values where all matches fit best."""
    pose, values, weak = to_T_lidar_camera(T_camera_lidar), lens.values, weak_information(lens)
    each = len(by_place.places), 1, 1
    for _ in range(_MOST_STEPS):
        sums = by_place.sums(np.tile(to_T_camera_lidar(pose), each), values)
        pull = sum(one.gradient for one in sums) + weak @ np.concatenate([np.zeros(6), values])
        step = -np.linalg.solve(sum(one.hessian for one in sums) + weak, pull)
        pose, values = pose.retract(step[:6]), values + step[6:]
        if -step @ pull < _MINIMAL:
            break
    return np.tile(to_T_camera_lidar(pose), each), values


def _frame_scatter(free: FreeLensBlock, placed: BlockByPlace, at: tuple[Array, Array]) -> Array:
    """(6 + k, 6 + k) sum of the outer products of the gradients of frames."""
    counts = placed.count_of_frame[np.argsort(placed.place_of_frame, kind="stable")]
    columns = free.columns(at[0][0], at[1])
    pulls = (columns[:-1] * (free.loss(columns)[1] * columns[-1])).sum(axis=1)
    gradients = np.add.reduceat(pulls, np.cumsum(counts) - counts, axis=1).T
    return np.asarray(gradients.T @ gradients)


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
        values, sigmas = (
            fit.linear.shared.atVector(key),
            np.sqrt(np.diag(fit.linear.covariance_of([key]))),
        )
        moved[name] = lenses[name].moved_to(values)
        largest = max(largest, float((abs(values - lenses[name].values) / sigmas).max()))
    return moved, largest

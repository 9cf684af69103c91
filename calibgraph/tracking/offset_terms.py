"""Time offsets in the graph of the tracker: from sums of frames, place by place."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calibgraph.arrays import Array
from calibgraph.graph.by_place import QuadraticByPlace
from calibgraph.graph.lens import LensTerm
from calibgraph.graph.variables import seen_lens_key
from calibgraph.model.findings import MatcherFindings
from calibgraph.solver.lens import information_in_graph, lens_term_of
from calibgraph.solver.within_place import WEAK, WithinPlace
from calibgraph.tracking.epoch_sums import sum_all_epochs
from calibgraph.tracking.offset_sums import after_offset_walk
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums

Numbers = NDArray[np.int64]


def offset_term(
    state: State, camera: int, sums: Sums, within: WithinPlace, *, frames: Sequence[int]
) -> LensTerm:
    """The offset of a camera in the error model; scan distortion does not displace it.

    Args:
        state: of the tracker.
        camera: by its place in the rig.
        sums: (p,) of the camera at each place where it has frames, in the order of time.
        within: what its matches of one of these places share.
        frames: (p,) over which the offset walks from each place to the next, or to the present.
    """
    assert state.offsets is not None
    lens = state.offsets.variable(state.rig, camera)
    units, total = _units(lens.free.sigmas[0]), Sums.zeros(width=7)
    findings: MatcherFindings = state.findings
    of_poses = within.at_place(findings.place_variance)
    hessians = with_shared_errors(units @ sums.reweighted @ units, of_poses, within.least)
    each = information_in_graph(hessians, of_poses, within.least, lens)
    gathered, step = np.zeros((7, 7)), walk_in_graph(state, camera)
    for row, count in enumerate(frames):
        total, gathered = total + sums[row], gathered + each[row]
        if count and step:
            total = _after_walk(state, camera, total, count)
            walked = np.diag([0.0] * 6 + [step * count])
            gathered = np.linalg.solve(np.eye(7) + gathered @ walked, gathered)
    in_graph = np.asarray(np.linalg.inv(gathered), dtype=np.float64)
    shown = units @ total.reweighted @ units, units @ total.scatter @ units, in_graph
    counts = float(total.matches), float(total.frames)
    term = lens_term_of(lens, shown, counts, within, findings=findings)
    bends = len(findings.bend_sigmas)
    value_s, variance = _earlier(state, camera)
    sigma, mean = lens.free.sigmas[0], lens.free.clock.offset_s
    earlier = (value_s - mean) / sigma, variance**0.5 / sigma
    known = earlier if np.isfinite(variance) else None
    return LensTerm(lens, term.excess, np.zeros((1, bends)), term.compensating, known)


def with_shared_errors(hessians: Array, of_poses: Array, least: float) -> Array:
    """(p, 7, 7) Hessians of places whose matches share errors, also where these look like offsets.

    A pose and an offset at once are as uncertain as the pose alone: what a_cp adds to the variance
    of the matches holds for the offset, too, with the pose that follows it.

    Args:
        hessians: (p, 7, 7) of independent matches.
        of_poses: (p, 6, 6) covariance of a_cp about m_c.
        least: variance of the matches in the graph.
    """
    poses, across = hessians[:, :6, :6], hessians[:, :6, 6:]
    alone = hessians[:, 6:, 6:] - across.swapaxes(1, 2) @ np.linalg.solve(poses + WEAK, across)
    more = np.trace(poses @ of_poses, axis1=1, axis2=2) / (6 * least)
    found = hessians.copy()
    found[:, 6, 6] -= (alone[:, 0, 0] * more) / (1 + more)
    return found


def walk_in_graph(state: State, camera: int) -> float:
    """The variance of the walk of an offset over a frame, in the units of its variable."""
    assert state.offsets is not None
    prior_s = state.offsets.variable(state.rig, camera).free.sigmas[0]
    return float((state.config.tracking.walk_time_offset_s / prior_s) ** 2)


def _after_walk(state: State, camera: int, sums: Sums, frames: int) -> Sums:
    variance = state.walk_variance(np.zeros(1), frames)[0]
    return after_offset_walk(sums, variance, np.array(state.overconfidence(camera)))


def keep_offsets(state: State, cameras: Iterable[int], since: int) -> State:
    """The state with what the frames before a move of some cameras show of their time offsets.

    The number of a frame says since when. No less uncertain than the graph has them.
    """
    if state.offsets is None:
        return state
    sums, offsets = sum_all_epochs(state, since), state.offsets
    later = sum(1 for frame in state.live_frames if frame.number >= since)
    for camera in cameras:
        known = _shown(state, camera, sums[camera])
        offsets = offsets.with_earlier(camera, *known, state.updates - later)
    return replace(state, offsets=offsets)


def _shown(state: State, camera: int, own: Sums) -> tuple[float, float]:
    """Value [s] and variance of an offset by (7,) sums and by earlier ones, without its prior."""
    assert state.offsets is not None
    free = state.offsets.variable(state.rig, camera).free
    step, covariance = _estimate(state, camera, own)
    found_s = float(state.offsets.values_s[camera] + step[6])
    prior, variance = free.sigmas[0] ** -2, covariance[6, 6]
    variance = max(variance, state.offsets.sigmas_s[camera] ** 2)
    left = 1 / variance - prior
    if left <= 0:
        return 0.0, np.inf
    return (found_s / variance - free.clock.offset_s * prior) / left, 1 / left


def _estimate(state: State, camera: int, own: Sums) -> tuple[Array, Array]:
    """(7,) step and (7, 7) covariance of pose and offset by sums, with all else that is known."""
    assert state.offsets is not None
    value_s, free = state.offsets.values_s[camera], state.offsets.variable(state.rig, camera).free
    earlier_s, variance = _earlier(state, camera)
    k, information = state.overconfidence(camera), np.array([free.sigmas[0] ** -2, 1 / variance])
    away_s = np.array([free.clock.offset_s, earlier_s]) - value_s
    alone = np.diag(np.append(np.zeros(6), k * information.sum()))
    inverse = np.linalg.inv(own.hessian + alone + block_diag(WEAK, 0.0))
    gradient = own.gradient - np.append(np.zeros(6), k * (information @ away_s))
    scatter = state.inflation(camera) * own.scatter + k * alone
    return -inverse @ gradient, inverse @ scatter @ inverse


def score_after(state: State, camera: int, before: Sums, after: Sums) -> tuple[Array, Array]:
    """(6,) gradient of later frames at the estimate by earlier ones, and its (6, 6) covariance.

    Both sets have one offset but for its walk. So an error of the offset displaces both, and counts
    only as far as their motions differ.

    Args:
        state: of the tracker.
        camera: by its place in the rig.
        before: (7,) sums of the earlier frames.
        after: of the later ones.
    """
    step, covariance = _estimate(state, camera, before)
    covariance[6, 6] += state.config.tracking.walk_time_offset_s**2 * after.frames
    by = after.hessian[:6]
    noise = state.inflation(camera) * after.scatter[:6, :6]
    return after.gradient[:6] + by @ step, noise + by @ covariance @ by.T


def _earlier(state: State, camera: int) -> tuple[float, float]:
    """Value [s] of an offset before its camera's last move, and variance after its walk since."""
    assert state.offsets is not None
    value_s, variance, at = state.offsets.earlier[camera].tolist()
    walk = state.config.tracking.walk_time_offset_s**2 * (state.updates - at)
    return value_s, variance + walk


def late_quadratic(
    state: State,
    camera: int,
    places: Numbers,
    chosen: Sequence[tuple[gtsam.Pose3, float, Array]],
) -> QuadraticByPlace:
    """The matches of a camera, by T_lidar_camera, offset [s] and (7, 7) information at places."""
    assert state.offsets is not None
    lens = state.offsets.variable(state.rig, camera)
    sigma = lens.free.sigmas[0]
    units = _units(sigma)
    away_s = np.array([offset for _, offset, _ in chosen]) - lens.free.clock.offset_s
    information = np.array([units @ one @ units for _, _, one in chosen]).reshape(-1, 7, 7)
    poses = [pose for pose, _, _ in chosen]
    keys = [seen_lens_key(camera)] * len(places)
    return QuadraticByPlace(places, poses, information, away_s[:, None] / sigma, keys)


def _units(sigma_s: float) -> Array:
    """(7, 7) from the units of the variable to seconds."""
    return np.diag(np.append(np.ones(6), sigma_s))

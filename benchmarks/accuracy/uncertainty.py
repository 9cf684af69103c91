"""Errors of many simulated draws against the reported covariances.

    python -m benchmarks.accuracy.uncertainty [--draws 200] [--frames 30] [--matches 100]
    python -m benchmarks.accuracy.uncertainty --awkward

Errors of the simulated matcher: 1 px independent, 1 px shared by a camera's frame, 15 % outliers.
NEES is the squared error in the metric of its covariance; its mean over 6 should be 1. The region
that should hold 95 % of the errors is that of a chi-squared law with 6 degrees of freedom. For
comparison: (J^T J)^-1, the inverse of the information of independent correspondences.

``--awkward`` draws tables of few frames, of copied frames, and with measured relative poses, with
the errors of three matchers, all of the same variance. Of the variance of a match, half is shared
by its camera's frame (``half``, as above), or a fifth, as the solver takes for usual (``fifth``).
With ``shared``, all frames share a displacement of the cloud and of each camera besides, of the
size that the matcher ``structure`` states, and the table states it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.tables import Table, parser_of, publish
from calibgraph import (
    Config,
    Correspondences,
    MatcherErrors,
    Rig,
    concatenate,
    simulate_correspondences,
)
from calibgraph.model.geometry import (
    relative_covariance,
    relative_transform,
    to_T_lidar_camera,
    twist_between,
)
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.solution import Solution
from calibgraph.trust.evidence import Evidence
from tests.draws.places import FIFTH, Drawn, displaced, stereo, tied

Array = NDArray[np.float64]
Rng = np.random.Generator

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.15)
SHARED = np.repeat([np.radians(0.09), 0.02], 3)


COLUMNS = ("error of", "covariance", "mean NEES / 6", "in the 95 % region")


def main() -> None:
    """Draw, solve, and print one table."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--matches", type=int, default=100)
    parser.add_argument("--awkward", action="store_true", help="few frames, copies, tied cameras")
    parser.add_argument("--cases", nargs="+", default=[*CASES], choices=[*CASES])
    options = parser.parse_args()
    table = awkward_cases(options) if options.awkward else both_covariances(options)
    publish("accuracy.uncertainty", [table], record=options.record)


def both_covariances(options: argparse.Namespace) -> Table:
    """Errors of full tables by our covariance and by that of independent correspondences."""
    found: dict[tuple[str, str], list[float]] = {}
    for seed in range(options.draws):
        for of, covariance, nees in draw(options.frames, options.matches, seed):
            found.setdefault((of, covariance), []).append(nees)
    rows = tuple((*name, *calibration(values)) for name, values in found.items())
    title = f"{options.draws} draws, {options.frames} frames, {options.matches} matches each"
    return Table(title, COLUMNS, rows)


def calibration(nees: Sequence[float]) -> tuple[str, str]:
    """Their mean over 6, and the share in the region that should hold 95 %."""
    inside = np.mean(np.array(nees) < chi2.ppf(0.95, 6))
    return f"{np.mean(nees) / 6:.2f}", f"{inside:.1%}"


def draw(frames: int, matches: int, seed: int) -> Iterator[tuple[str, str, float]]:
    """One draw: error of what, by which covariance, its NEES."""
    rig = stereo()
    table = simulate_correspondences(rig, frames=frames, matches=matches, errors=ERRORS, seed=seed)
    solved = solve_joint(rig, table, Config())
    ours = Evidence(solved, guess=rig).joint_covariance
    for which, joint in (("by frames (ours)", ours), ("(J^T J)^-1", independent(solved))):
        for what, nees in nees_of(solved, rig, joint):
            yield what, which, nees


def nees_of(solved: Solution, truth: Rig, joint: Array | None) -> Iterator[tuple[str, float]]:
    """Error of what, its NEES."""
    assert joint is not None
    right = truth.T_camera_lidar
    each = [twist_between(T, right[name]) for name, T in solved.T_camera_lidar.items()]
    errors = np.concatenate(each)
    for what, error, covariance in parts(solved, errors, joint):
        yield what, float(error @ np.linalg.solve(covariance, error))


def parts(solved: Solution, errors: Array, joint: Array) -> Iterator[tuple[str, Array, Array]]:
    """Each camera and the pair: its error and covariance."""
    for place, name in enumerate(solved.T_camera_lidar):
        rows = slice(6 * place, 6 * place + 6)
        yield name, errors[rows], joint[rows, rows]
    left, right = solved.T_camera_lidar.values()
    T_right_left = relative_transform(right, left)
    of_pair = errors[6:] - gtsam.Pose3(T_right_left).AdjointMap() @ errors[:6]
    yield "left->right", of_pair, relative_covariance(joint, 0, 1, T_right_left)


def independent(solved: Solution) -> Array:
    """(12, 12) inverse of the information of all inliers, taken for independent."""
    joint = np.zeros((12, 12))
    for place, (name, matches) in enumerate(solved.inliers.blocks.items()):
        rows = slice(6 * place, 6 * place + 6)
        block = matches.with_scale(solved.scales[name])
        sums = block.sums(to_T_lidar_camera(solved.T_camera_lidar[name]))
        joint[rows, rows] = np.linalg.inv(sums.hessian)
    return joint


Change = Callable[[Drawn, Rng], Drawn]


def draw_full(matcher: str, options: argparse.Namespace, rng: Rng) -> Drawn:
    """Correspondences of both cameras in all frames, of one of the matchers."""
    truth, shared, seed = stereo(), matcher == "shared", int(rng.integers(2**31))
    table = simulate_correspondences(
        displaced(truth, *draw_shared(rng)) if shared else truth,
        frames=options.frames,
        matches=options.matches,
        errors=MATCHERS[matcher],
        seed=seed,
    )
    return Drawn(truth, state_shared(table) if shared else table)


def draw_shared(rng: Rng) -> tuple[Array, Array]:
    """(6,) motion of the cloud and (2, 6) of the cameras' matches, each with half the variance."""
    half = SHARED / np.sqrt(2)
    return half * rng.standard_normal(6), half * rng.standard_normal((2, 6))


def state_shared(table: Correspondences) -> Correspondences:
    """The table of a matcher that states the error that all its frames share."""
    stated = {"systematic_rotation_rad": SHARED[0], "systematic_translation_m": SHARED[3]}
    return replace(table, metadata={**table.metadata, **stated})


def left_frames(drawn: Drawn, rng: Rng, *, count: int) -> Drawn:
    """The left camera has matches in the first frames only."""
    table = drawn.table
    of_left = table.camera_index == table.cameras.index("left")
    return replace(drawn, table=table.select(~of_left | (table.frame < count)))


def tied_alone(drawn: Drawn, rng: Rng, *, deg: float, cm: float) -> Drawn:
    """The same, and the right camera has no matches."""
    table = drawn.table
    of_left = table.select(table.camera_index == table.cameras.index("left"))
    return replace(tied(drawn, rng, deg=deg, cm=cm), table=of_left)


def first_frames(drawn: Drawn, rng: Rng, *, count: int) -> Drawn:
    """Both cameras have matches in the first frames only."""
    return replace(drawn, table=drawn.table.select(drawn.table.frame < count))


COPIED, COPIES = 3, 10


def copied(drawn: Drawn, rng: Rng, *, noise_px: float = 0.0, named: bool = False) -> Drawn:
    """The first frames, each under ten numbers, with some noise of their own.

    Args:
        drawn: a full table.
        rng: draws the noise.
        noise_px: standard deviation per axis; copies are equal to the last bit without any.
        named: whether the table states which frames are of one place (``stationary``).
    """
    first = drawn.table.select(drawn.table.frame < COPIED)
    numbers = [COPIED * copy for copy in range(COPIES)]
    table = concatenate([replace(first, frame=first.frame + number) for number in numbers])
    noise = noise_px * rng.standard_normal(table.pixels_px.shape)
    same = [[frame + number for number in numbers] for frame in range(COPIED)] if named else []
    metadata = {**first.metadata, "stationary": same}
    return replace(
        drawn, table=replace(table, pixels_px=table.pixels_px + noise, metadata=metadata)
    )


MATCHERS = {"half": ERRORS, "fifth": FIFTH, "shared": FIFTH}
_SHARE, _STATED, _ONE = ("half", "fifth"), ("half", "shared"), ("half",)
CASES: dict[str, tuple[Change, tuple[str, ...]]] = {
    **{f"{count} frame{'s' * (count > 1)} of left": (partial(left_frames, count=count), _SHARE)
       for count in (1, 2, 3, 5, 10, 30)},
    **{f"{name}, {deg} deg {cm} cm": (partial(change, deg=deg, cm=cm), _STATED)
       for name, change in (("right tied alone", tied_alone), ("matches and tied", tied))
       for deg, cm in ((2.9, 30), (0.1, 1))},
    "3 frames of both": (partial(first_frames, count=COPIED), _ONE),
    "10 copies": (copied, _ONE),
    "10 copies, 0.1 px of noise, named": (partial(copied, noise_px=0.1, named=True), _ONE),
    "10 copies, 0.1 px of noise": (partial(copied, noise_px=0.1), _ONE),
}  # fmt: skip
"""Per case, what is done to a full table, and whose errors are drawn."""


def awkward_cases(options: argparse.Namespace) -> Table:
    """A row per case, matcher, and camera or pair."""
    rows = []
    for case in options.cases:
        change, matchers = CASES[case]
        for matcher in matchers:
            found: dict[str, list[float]] = {}
            for seed in range(options.draws):
                for of, nees in draw_awkward(change, matcher, options, seed):
                    found.setdefault(of, []).append(nees)
            rows += [(case, matcher, of, *calibration(values)) for of, values in found.items()]
    title = (
        f"{options.draws} draws, {options.frames} frames unless stated, {options.matches} matches "
        "each; half, fifth: share of a match's variance that is its frame's; shared: a fifth, and "
        "a displacement by 0.09 deg, 2 cm per axis that all frames share and the table states"
    )
    return Table(title, ("case", "matcher", "error of", *COLUMNS[2:]), tuple(rows))


def draw_awkward(
    change: Change, matcher: str, options: argparse.Namespace, seed: int
) -> Iterator[tuple[str, float]]:
    """One draw: error of what, its NEES."""
    rng = np.random.default_rng(seed)
    drawn = change(draw_full(matcher, options, rng), rng)
    solved = solve_joint(drawn.rig, drawn.table, Config())
    yield from nees_of(solved, drawn.rig, Evidence(solved, guess=drawn.rig).joint_covariance)


if __name__ == "__main__":
    main()

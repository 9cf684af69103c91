"""Errors of tables of several places against the reported covariances.

    python -m benchmarks.accuracy.place_draws [--draws 200] [--cases "5 places" ...]

Errors are drawn from the error model itself, as the matcher ``structure`` states it: what bends the
cloud, what displaces it everywhere and at a place, the matches of a camera everywhere and at a
place (in the shape of its information), three frames each, matches of which share a fifth of their
variance. So the table checks the algebra, and what is made of the sizes, not whether recordings are
like that; that is ``error_bars``. NEES is the squared error in the metric of its covariance; its
mean over 6 should be 1. Errors of single cameras and of pairs are medians; before: all matches
independent.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.uncertainty import calibration, left_frames, nees_of, parts, tied_alone
from benchmarks.tables import Table, add_record_option, publish
from calibgraph import Config, Rig, concatenate
from calibgraph.model.geometry import twist_between
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.solution import Solution
from calibgraph.trust.evidence import Evidence
from tests.draws.places import (
    FRAMES,
    Drawn,
    draw_places,
    tied,
)

Array = NDArray[np.float64]
Rng = np.random.Generator

COLUMNS = (
    "case", "error of", "mean NEES / 6", "in the 95 % region", "error [deg]", "[cm]",
    "before [deg]", "[cm]",
)  # fmt: skip


def main() -> None:
    """Draw, solve, and print one table."""
    options = parse_options(__doc__, [*CASES])
    rows = [row for case in options.cases for row in rows_of(case, options.draws, options.matches)]
    title = f"{options.draws} draws, {FRAMES} frames a place, {options.matches} matches each"
    publish("accuracy.place_draws", [Table(title, COLUMNS, tuple(rows))], record=options.record)


def parse_options(description: str | None, cases: list[str]) -> argparse.Namespace:
    """How many draws of how many matches, and which cases."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--matches", type=int, default=100)
    parser.add_argument("--cases", nargs="+", default=cases, choices=cases)
    add_record_option(parser)
    return parser.parse_args()


def rows_of(case: str, draws: int, matches: int) -> Iterator[tuple[str, ...]]:
    """Each camera and the pair."""
    places, changes = CASES[case]
    found: dict[str, list[float]] = {}
    errors: dict[str, list[Array]] = {}
    for seed in range(draws):
        rng = np.random.default_rng([17, seed])
        drawn = draw_places(places, matches, rng)
        for change in changes:
            drawn = change(drawn, rng)
        solved = solve_joint(drawn.rig, drawn.table, Config(learnt_weights=False, of="mount"))
        joint = Evidence(solved, guess=drawn.rig).joint_covariance
        for of, nees in nees_of(solved, drawn.rig, joint):
            found.setdefault(of, []).append(nees)
        for of, sizes in errors_of(solved, drawn.rig):
            errors.setdefault(of, []).append(sizes)
    for of, nees_values in found.items():
        after_deg, after_cm, before_deg, before_cm = np.median(errors[of], axis=0)
        yield (case, of, *calibration(nees_values), f"{after_deg:.3f}", f"{after_cm:.2f}",
               f"{before_deg:.3f}", f"{before_cm:.2f}")  # fmt: skip


def errors_of(solved: Solution, truth: Rig) -> Iterator[tuple[str, Array]]:
    """Of each camera and the pair: deg and cm, then those of independent matches."""
    flat = solved.inliers.minimize(solved.T_camera_lidar, solved.scales).T_camera_lidar
    sizes = []
    for T in (solved.T_camera_lidar, flat):
        twists = [twist_between(T[n], c.T_camera_lidar) for n, c in truth.cameras.items()]
        found = parts(solved, np.concatenate(twists), np.eye(12))
        sizes.append({of: (np.degrees(np.linalg.norm(e[:3])), 100 * np.linalg.norm(e[3:]))
                      for of, e, _ in found})  # fmt: skip
    for of, after in sizes[0].items():
        yield of, np.array([*after, *sizes[1][of]])


def one_place_off(drawn: Drawn, rng: Rng, *, deg: float, cm: float) -> Drawn:
    """The cloud of the first place is turned and displaced by as much, in a random direction."""
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    step = np.concatenate([np.radians(deg) * axes[0], cm / 100 * axes[1]])
    T = gtsam.Pose3.Expmap(step).matrix()
    table = drawn.table
    points, there = table.points_lidar_m.copy(), table.frame < FRAMES
    points[there] = points[there] @ T[:3, :3].T + T[:3, 3]
    return replace(drawn, table=replace(table, points_lidar_m=points))


def copied_place(drawn: Drawn, rng: Rng) -> Drawn:
    """The first place ten times, as if it were ten places."""
    first = drawn.table.select(drawn.table.frame < FRAMES)
    more = [replace(first, frame=first.frame + 100 * copy) for copy in range(1, 10)]
    table = concatenate([drawn.table, *more])
    return replace(drawn, table=replace(table, metadata=drawn.table.metadata))


Change = Callable[[Drawn, Rng], Drawn]
CASES: dict[str, tuple[int, tuple[Change, ...]]] = {
    "1 place": (1, ()),
    "2 places": (2, ()),
    "5 places": (5, ()),
    "10 places": (10, ()),
    "20 places": (20, ()),
    "1 place, tied by 0.02 deg 0.3 cm": (1, (partial(tied, deg=0.02, cm=0.3),)),
    "5 places, tied by 0.02 deg 0.3 cm": (5, (partial(tied, deg=0.02, cm=0.3),)),
    "5 places, right tied alone": (5, (partial(tied_alone, deg=0.02, cm=0.3),)),
    "5 places, 1 frame of left": (5, (partial(left_frames, count=1),)),
    "5 places, 3 frames of left": (5, (partial(left_frames, count=3),)),
    "5 places, one of them 10 times": (5, (copied_place,)),
    "5 places, one 0.3 deg 6 cm off": (5, (partial(one_place_off, deg=0.3, cm=6.0),)),
    "5 places, one 1 deg 20 cm off": (5, (partial(one_place_off, deg=1.0, cm=20.0),)),
}
"""Per case, the number of places, and what is done to the table."""


if __name__ == "__main__":
    main()

"""Where LiDARs are, roughly: by the ground that each sees, and by upright things from above.

The ground gives the direction up and the height of each LiDAR. Then two clouds differ by a heading
and a shift, of which all are tried: the images of upright things from above are correlated, heading
by heading. The likeliest are refined by planes, and the one whose upright planes agree best is
taken. Where another one agrees as well, as in a room that looks alike from both ends, a line states
that.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.matching.cloud_similarity import find_upright, image_from_above
from calibgraph.model.geometry import angle_deg, invert, move_points, transform
from calibgraph.vehicle.lidars import count_matched, refine_poses
from calibgraph.vehicle.planes import View, Views, thinned

_GRID = _CELLS, _CELL_M = 192, 0.5  # of an image from above
_FROM_M, _TO_M = 0.4, 6.0  # over the ground: what is upright
_STEP_DEG = 3.0  # between headings
_APART_M = 12.0  # of two LiDARs of one vehicle
_NEAR_DEG, _NEAR_M = 35.0, 2.5  # of a guess
_TRIED, _PER_HEADING = 8, 3  # placements that are refined; of them with a similar heading
_TRIED_ALONG = 24  # where the heading alone is known: along a street, all shifts look alike
_INSTANTS = 3  # that are looked at
_LEAST_ON, _LEAST_SHARE = 15, 0.7
"""Upright planes that lie on another's, and their share of those near one. Of two vehicles (carla,
opencalib) right placements have 18 and more, 0.75 and more, but for one of 6; clouds of two places
have up to 11, and with more than 5 up to 1.0."""
_ROUNDS, _MOST_PLANES = 9, 2000  # of refining
_PEAK_DEG, _PEAK_M, _BAND_DEG = 10.0, 1.5, 15.0  # about one that has been tried; a similar heading
_POWER = 4  # of the share in a score: where poses are right, a plane off another's is rare
_AS_GOOD = 0.85  # of the best score
_OTHER_DEG, _OTHER_M = 5.0, 0.5  # from which a placement is another one


class _Placement(NamedTuple):
    """Upright planes that lie on others', their share of those near one, (4, 4) T_base_lidar."""

    on: int
    share: float
    T: Array

    @property
    def is_sure(self) -> bool:
        return self.on >= _LEAST_ON and self.share >= _LEAST_SHARE

    @property
    def score(self) -> float:
        return self.on * self.share**_POWER


def locate_lidars(
    views: Views,
    guess: Mapping[str, Array | None],
    *,
    base: str,
    turned: Collection[str] = (),
) -> tuple[dict[str, Array], dict[str, str], str]:
    """Rough (4, 4) T_base_lidar of LiDARs but the base; a line on each that fits twice.

    And why the others, which share too little with those, are not placed; empty if there are none.

    Args:
        views: as of :func:`calibgraph.vehicle.lidars.calibrate_lidars`.
        guess: per LiDAR but the base (4, 4), within some 30 degrees and 2 metres; None if unknown.
        base: whose frame it is.
        turned: names of those of whose guess the rotation alone is known.

    Raises:
        CalibrationError: if a LiDAR sees no ground, and one has no guess.
    """
    chosen = np.unique(np.linspace(0, len(views[base]) - 1, _INSTANTS).round().astype(int))
    seen = {
        name: [View(of[i].points_m, thinned(of[i].planes, _MOST_PLANES)) for i in chosen]
        for name, of in views.items()
    }
    T_up = _find_upright(seen, {base: np.eye(4), **guess})
    known, left, poses = seen[base], [name for name in views if name != base], dict[str, Array]()
    doubts, lost = dict[str, str](), ""
    while left and not lost:
        found = {}
        for name in left:
            place = None if name in turned else guess[name]
            tried = _placements(
                seen[name], known, T_up[name], T_up[base], turn=guess[name], guess=place
            )
            found[name], doubts[name] = _best(tried, place)
        lost = _why_lost(found, [base, *poses])
        for name, of in found.items():
            if of.is_sure:
                poses[name] = of.T
                known = [a.joined(b, of.T) for a, b in zip(known, seen[name], strict=True)]
        left = [name for name in left if name not in poses]
    return poses, {name: doubts[name] for name in poses if doubts[name]}, lost


def _find_upright(seen: Views, T_guess: Mapping[str, Array | None]) -> dict[str, Array]:
    """(4, 4) T_up_lidar; of a LiDAR without ground in view by the guesses, if all have one."""
    found = dict[str, Array]()
    for name, of in seen.items():
        try:
            found[name] = find_upright(name, [view.points_m for view in of])
        except CalibrationError:
            if any(T is None for T in T_guess.values()):
                raise
    known = {name: T for name, T in T_guess.items() if T is not None}
    ups = [T_up @ invert(known[name]) for name, T_up in found.items() if name in known]
    T_up_base = ups[0] if ups else np.eye(4)
    return {**{name: T_up_base @ T for name, T in known.items()}, **found}


def _why_lost(found: Mapping[str, _Placement], placed: Sequence[str]) -> str:
    """Empty if one is sure."""
    if any(each.is_sure for each in found.values()):
        return ""
    name = max(found, key=lambda each: found[each].on)
    return (
        f"LiDAR {name!r} shares too little with {', '.join(placed)}: {found[name].on} upright "
        f"planes lie on theirs, {found[name].share:.0%} of those near one; at least {_LEAST_ON} "
        f"and {_LEAST_SHARE:.0%} are needed: record where walls, poles or cars are in view of "
        "both, or write its T_base_lidar into rig.yaml"
    )


def _placements(
    own: Sequence[View], known: Sequence[View], T_up_own: Array, T_up_base: Array, *,
    turn: Array | None, guess: Array | None,
) -> list[_Placement]:  # fmt: skip
    """Refined placements that differ: of the guess, and of peaks of the images from above.

    Against what is known in the frame of the base; near the rotation of one (4, 4), and the
    position of another, if there are any.
    """
    headings, offsets, score = _correlate(own, known, T_up_own, T_up_base)

    def away(T_base_lidar: Array) -> tuple[Array, Array]:
        """(h,) [deg], (c, c) [m] from the heading and the position of a placement."""
        T = T_up_base @ T_base_lidar @ invert(T_up_own)
        turned = headings - np.degrees(np.arctan2(T[1, 0], T[0, 0]))
        at = np.linalg.norm(offsets - T[:2, 3], axis=-1)
        return np.abs((turned + 180.0) % 360.0 - 180.0), at

    if turn is not None:
        score[away(turn)[0] > _NEAR_DEG] = -np.inf
    if guess is not None:
        score[:, away(guess)[1] > _NEAR_M] = -np.inf
    found, similar = list[_Placement](), np.zeros(len(headings))
    slides = turn is not None and guess is None
    for number in range(_TRIED_ALONG if slides else _TRIED):
        heading, i, j = np.unravel_index(int(score.argmax()), score.shape)
        T = _turn(headings[heading])
        T[:2, 3] = offsets[i, j]
        start = invert(T_up_base) @ T @ T_up_own
        if guess is not None and number == 0:
            start = guess
        elif np.isinf(score[heading, i, j]):
            break
        refined = _refined(known, own, start, T_up_base[2, :3])
        found += [each for each in refined if guess is None or is_near(each.T, guess)]
        for T in (start, *(each.T for each in refined)):
            angles, shifted = away(T)
            score[(angles <= _PEAK_DEG)[:, None, None] & (shifted <= _PEAK_M)] = -np.inf
        if turn is None:
            similar += away(start)[0] <= _BAND_DEG
            score[similar >= _PER_HEADING] = -np.inf
    return found


def _correlate(
    own: Sequence[View], known: Sequence[View], T_up_own: Array, T_up_base: Array
) -> tuple[Array, Array, Array]:
    """(h,) headings [deg], (c, c, 2) positions of the LiDAR [m], (h, c, c) how well they fit."""
    upright, others = (
        [_upright_points(move_points(view.points_m, T_up)) for view in of]
        for of, T_up in ((own, T_up_own), (known, T_up_base))
    )
    spectra = [np.fft.rfft2(image_from_above(points, *_GRID)) for points in others]
    maps, headings = [], np.arange(0.0, 360.0, _STEP_DEG)
    for heading in headings:
        products = [
            one * np.fft.rfft2(image_from_above(move_points(two, _turn(heading)), *_GRID)).conj()
            for one, two in zip(spectra, upright, strict=True)
        ]
        maps.append(np.fft.irfft2(np.sum(products, axis=0)))
    score = np.fft.fftshift(np.array(maps), axes=(1, 2))
    steps = (np.arange(_CELLS) - _CELLS // 2) * _CELL_M
    offsets = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    score[:, np.linalg.norm(offsets, axis=-1) > _APART_M] = -np.inf
    return headings, offsets, score


def _turn(heading_deg: float) -> Array:
    return transform(Rotation.from_euler("z", heading_deg, degrees=True))


def _upright_points(points_up_m: Array) -> Array:
    """(n, 3) points over the ground, one of each voxel."""
    points = points_up_m[(points_up_m[:, 2] > _FROM_M) & (points_up_m[:, 2] < _TO_M)]
    points = points[np.hypot(points[:, 0], points[:, 1]) < _CELLS * _CELL_M / 2]
    i, j, k = np.floor(points / _CELL_M).astype(np.int64).T + 2 * _CELLS
    return points[np.unique((i * 4 * _CELLS + j) * 4 * _CELLS + k, return_index=True)[1]]


def _refined(
    known: Sequence[View], own: Sequence[View], start: Array, up: Array
) -> list[_Placement]:
    """Where a start ends, and how its upright planes agree there; ``up`` in the base frame."""
    planes, both = [[view.planes for view in of] for of in (known, own)], [np.eye(4), start]
    try:
        T, _ = refine_poses(planes, np.array(both), ("base", ""), rounds=_ROUNDS)
    except CalibrationError:  # hardly anything in common there
        return []
    near, on = (float(count[1]) for count in count_matched(planes, T, up=up))
    return [_Placement(int(on), on / max(near, 1.0), T[1])]


def _best(tried: Sequence[_Placement], guess: Array | None) -> tuple[_Placement, str]:
    """The placement whose planes agree best, and a line if another one is as good.

    Of such that are as good it is the one nearest to the guess.
    """
    best = max(tried, key=lambda each: each.score, default=_Placement(0, 0.0, np.eye(4)))
    as_good = [each for each in tried if each.score >= _AS_GOOD * best.score]
    if guess is not None and any(
        not is_near(each.T, best.T, _OTHER_DEG, _OTHER_M) for each in as_good
    ):
        best = min(as_good, key=lambda each: np.linalg.norm(each.T[:3, 3] - guess[:3, 3]))
    others = [each for each in as_good if not is_near(each.T, best.T, _OTHER_DEG, _OTHER_M)]
    if not others:
        return best, ""
    degrees, metres = max(distance_between(each.T, best.T) for each in others)
    return best, f"turned by {degrees:.0f} deg and moved by {metres:.1f} m it fits as well"


def distance_between(T_base_lidar: Array, other: Array) -> tuple[float, float]:
    """How far apart two placements are [deg, m]."""
    degrees = angle_deg(T_base_lidar[:3, :3] @ other[:3, :3].T)
    return degrees, float(np.linalg.norm(T_base_lidar[:3, 3] - other[:3, 3]))


def is_near(
    T_base_lidar: Array, other: Array, deg: float = _NEAR_DEG, metres: float = _NEAR_M
) -> bool:
    """Whether a placement is near another one; by default, as near as to a guess."""
    return bool((np.array(distance_between(T_base_lidar, other)) <= (deg, metres)).all())

"""Pose search: tries poses of the bodies of a rig, near a given one or all over the range."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.matching.structure.acceptance import (
    FALSE_ACCEPTANCE,
    FEW_FRAMES,
    least_z_score,
    probability_by_chance,
    second_look_chance,
)
from calibgraph.matching.structure.bodies import Body, lead, place, place_member, rigid_bodies
from calibgraph.matching.structure.box_search import BodyMaps, Box, search_box
from calibgraph.matching.structure.common_features import CommonFeatures
from calibgraph.matching.structure.correlation_maps import CorrelationMaps, correlate
from calibgraph.matching.structure.pose_refinement import (
    CONFIDENT,
    GAIN,
    CameraFrames,
    Candidate,
    approach,
    look_again,
    refine,
    refine_on,
)
from calibgraph.model.geometry import pose_difference, relative_transform, transform
from calibgraph.model.rig import Rig

SEARCH_WINDOWS, DENSE_WINDOWS = 2100, 9000  # of the maps, per camera over all frames
FEW_EFFORT = 2
"""In few frames maps are of dense windows, and there are more candidates of a box search by this
factor. In single frames of KITTI 05, 06 and raw 0005 right poses stand out by a z-score of 9 to 13
instead of 5 to 9 in these maps, where the best wrong ones have 9 to 11."""
ROLLS_RAD = np.radians([0.0, -12.0, 12.0])
"""Windows lie in the maps as they are seen from the guess: if it is rolled by more than some 8
degrees, right places stand out no more."""
SAME_DEG, SAME_CM = 1.0, 30.0
"""Poses nearer than this are the same: the rounds correct the error that refinements leave."""

DRAWS_AROUND, AROUND_RAD, AROUND_M = 12, np.radians(4.0), 0.8  # per axis
SURVIVORS = 2  # of these that are refined, those that are best after an approach
MAX_LOOKS = 3

PROMISING, FEW_PROMISING = 10.6, 9.0
"""More is tried about a pose from this z-score on: local optima had 10.8 and more; with few frames
9.5 and more, where wrong poses mostly end at 6 to 8.5."""


SearchRange = tuple[float, float]
"""How far from the guess to search, per axis: rotation [rad], translation [m]."""


class PoseSearch:
    """Tries poses of bodies, see :class:`.global_search.Locator`.

    Attributes:
        report: called with what is being done.
    """

    def __init__(
        self,
        rig: Rig,
        frames: Mapping[str, CameraFrames],
        search_range: SearchRange,
        *,
        seed: int,
        out_of_time: Callable[[], bool],
    ) -> None:
        self.rig, self.guess, self.out_of_time = rig, rig.T_camera_lidar, out_of_time
        self._frames, self._range, self._seed = frames, search_range, seed
        self.report: Callable[[str], None] = lambda _: None
        most = max((len(one.frames) for one in frames.values()), default=0)
        self._few = 0 < most <= FEW_FRAMES

    @cached_property
    def _common(self) -> CommonFeatures:
        return CommonFeatures(self.rig, self._frames, seed=self._seed)

    def shows_something(self, body: Body) -> bool:
        """Whether any image of the body does."""
        return any(gray.shows_something for name in body for gray in self._frames[name].grays)

    def near(self, body: Body) -> Candidate:
        """Refine the body from its guess, and from the best pose of a coarse approach."""
        direct = refine(self._frames, body)
        if direct.is_beyond_doubt or self.out_of_time():
            return direct
        if direct.z_score < CONFIDENT:
            direct = max(direct, self.from_afar(body), key=_by_z_score)
        return self._settle(direct)

    def from_afar(self, body: Body) -> Candidate:
        """The body near a pose that may be off by some degrees."""
        return refine(self._frames, approach(self._frames, body).body)

    def at(self, body: Body) -> Candidate:
        """The body near a pose that is off by less than a degree."""
        return self._settle(refine(self._frames, body))

    def everywhere(self, body: Body, effort: int, tries: float) -> Candidate:
        """The best pose in all of the range; of those from CONFIDENT on, the first.

        In few frames, the best of the rolls up to the first that is accepted after so many tries.
        """
        best = Candidate(body, -math.inf)
        for number, roll in enumerate(ROLLS_RAD, 1):
            self.report(f"searching: {next(iter(body))}, roll {number} of {len(ROLLS_RAD)}")
            best = max(best, self.with_roll(body, roll, effort=effort), key=_by_z_score)
            if best.z_score >= CONFIDENT or self.out_of_time():
                break
            if self._few and is_accepted(self.second_look(best, tries), tries):
                break
        return best

    def with_roll(self, body: Body, roll_rad: float, *, effort: int) -> Candidate:
        """The best pose all over the range about a body's guess, with maps for one roll.

        All candidates of the box search are refined, after an approach and without one, which may
        lead away from the right pose, but not twice at one pose.
        """
        rolled = transform(Rotation.from_rotvec([0.0, 0.0, roll_rad])) @ lead(body).T_camera_lidar
        maps = self._correlate(place(body, rolled), effort)
        nothing = Candidate(body, -math.inf)
        if not maps.maps:
            return nothing
        box = Box(lead(body).T_camera_lidar, *self._range)
        cores = self._frames[next(iter(body))].cores
        more = FEW_EFFORT * effort if self._few else effort
        found = search_box(maps, box, cores, effort=more, seed=self._seed + effort)
        starts = [place(body, T_lead_lidar) for T_lead_lidar in found]
        near = sorted(self._while_time(approach, starts), key=_by_z_score, reverse=True)
        best = nothing
        for candidate in self._while_time(refine, distinct([*(one.body for one in near), *starts])):
            best = max(best, candidate, key=_by_z_score)
            if best.z_score >= CONFIDENT:
                break
        return self._settle(best)

    def _while_time(
        self, improve: Callable[[Mapping[str, CameraFrames], Body], Candidate], bodies: list[Body]
    ) -> Iterator[Candidate]:
        """The bodies improved, at least the first one."""
        for body in bodies:
            yield improve(self._frames, body)
            if self.out_of_time():
                return

    def second_look(self, candidate: Candidate, tries: float) -> Candidate:
        """In few frames, the candidate at the fine levels, and how probable it is by chance.

        There right poses are too near to chance for the last level of the search alone. With more
        frames, the candidate itself.
        """
        if not self._few:
            return candidate
        chance = probability_by_chance(candidate.z_score, tries)
        if chance > FALSE_ACCEPTANCE and candidate.z_score < FEW_PROMISING:
            return replace(candidate, chance=chance)
        fine = look_again(self._frames, candidate.body)
        if chance > FALSE_ACCEPTANCE:
            mirrored = second_look_chance(self._mirrored_evidence)
            chance = probability_by_chance(candidate.z_score + fine.z_score, tries, mirrored)
        return replace(candidate, body=fine.body, chance=chance)

    def _evidence(self, candidate: Candidate) -> float:
        return candidate.z_score + look_again(self._frames, candidate.body).z_score

    @cached_property
    def _mirrored_evidence(self) -> float:
        """Mean over the bodies of the most that a search finds in mirrored images: by chance.

        These are as alike to the clouds as images of other places of the kind. For one roll: the
        acceptance counts the searches.
        """
        frames = {
            name: replace(one, grays=[gray.mirrored() for gray in one.grays])
            for name, one in self._frames.items()
        }
        search = PoseSearch(
            self.rig, frames, self._range, seed=self._seed, out_of_time=self.out_of_time
        )
        evidence = []
        for body in filter(self.shows_something, rigid_bodies(self.rig)):
            self.report(f"searching mirrored images: {next(iter(body))}")
            found = search.with_roll(body, ROLLS_RAD[0], effort=1)
            if math.isfinite(found.z_score):
                evidence.append(search._evidence(found))
        if self.out_of_time() or not evidence:  # of a search that was cut, chance is not known
            return math.inf
        return float(np.mean(evidence))

    def seen_by(self, other: Body, body: Body) -> Body | None:
        """The body where a located one sees it; None if they see nothing in common."""
        for name in body:
            for by, camera in other.items():
                T = self._common.place(name, by, camera.T_camera_lidar)
                if T is not None:
                    return place_member(body, name, T)
        return None

    def as_in_guess(self, other: Body, body: Body) -> Body:
        """The body at its relative pose in the guess to a located one."""
        by, camera = next(iter(other.items()))
        old = lead(body).T_camera_lidar
        relative = relative_transform(old, self.guess[by])
        return place(body, relative @ camera.T_camera_lidar)

    def _settle(self, candidate: Candidate) -> Candidate:
        """Refine a candidate further, and look around it for a better one.

        Where few of the windows agree, as with the far ones alone, a pose some degrees and
        decimetres off can agree far better than by chance.
        """
        for _ in range(MAX_LOOKS):
            hopeless = candidate.z_score < (FEW_PROMISING if self._few else PROMISING)
            if hopeless or candidate.is_beyond_doubt or self.out_of_time():
                break
            refined = candidate
            if candidate.z_score < CONFIDENT:
                refined = refine_on(self._frames, candidate)
            if refined.is_beyond_doubt:
                return refined
            around = self._best_around(refined)
            if around.z_score < GAIN * refined.z_score:
                return refined
            candidate = around
        return candidate

    def _best_around(self, candidate: Candidate) -> Candidate:
        """The best pose that approaches from poses drawn around a candidate lead to."""
        box = Box(lead(candidate.body).T_camera_lidar, AROUND_RAD, AROUND_M)
        unit = np.random.default_rng(self._seed).uniform(-1.0, 1.0, (DRAWS_AROUND, 6))
        drawn = box.transforms(unit * box.half_widths)
        near = [approach(self._frames, place(candidate.body, T)) for T in drawn]
        near.sort(key=_by_z_score, reverse=True)
        others = [
            one.body for one in near[:SURVIVORS] if not is_same_pose(one.body, candidate.body)
        ]
        return max(
            (refine(self._frames, body) for body in others), key=_by_z_score, default=candidate
        )

    def _correlate(self, body: Body, effort: int) -> BodyMaps:
        """The maps of those cameras that the clouds are in view of."""
        windows = DENSE_WINDOWS if self._few else SEARCH_WINDOWS
        maps, T_camera_lead, of_lead = list[CorrelationMaps](), [], lead(body).T_camera_lidar
        for name, camera in body.items():
            frames = self._frames[name]
            found = correlate(
                frames.grays,
                frames.clouds,
                camera,
                frames.cores,
                range_rad=self._range[0],
                max_windows=effort * windows // len(frames.grays),
                dense=self._few,
                seed=self._seed + 1000 * (effort - 1),
            )
            if len(found.maps):
                maps.append(found)
                T_camera_lead.append(relative_transform(camera.T_camera_lidar, of_lead))
        return BodyMaps(maps, T_camera_lead)


def is_same_pose(one: Body, two: Body) -> bool:
    """Whether two poses of a body are so near that refinements and rounds end alike."""
    return are_same_pose(lead(one).T_camera_lidar, lead(two).T_camera_lidar)


def are_same_pose(T_one: Array, T_two: Array) -> bool:
    """The same of two (4, 4) T_camera_lidar."""
    degrees, centimetres = pose_difference(T_one, T_two)
    return degrees < SAME_DEG and centimetres < SAME_CM


def distinct(bodies: Iterable[Body]) -> list[Body]:
    """The bodies without those at the pose of an earlier one."""
    kept: list[Body] = []
    for body in bodies:
        if not any(is_same_pose(body, other) for other in kept):
            kept.append(body)
    return kept


def is_accepted(candidate: Candidate, tries: float) -> bool:
    """Whether a candidate agrees far better than by chance, after so many tries."""
    if candidate.chance is not None:
        return candidate.chance <= FALSE_ACCEPTANCE
    return candidate.z_score >= least_z_score(tries)


def _by_z_score(candidate: Candidate) -> float:
    return candidate.z_score

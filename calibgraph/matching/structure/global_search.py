"""Global search: where the rounds begin, at the guess if it is near enough, else where it finds.

A pose is accepted when images and clouds agree at it far better than by chance; the more poses were
tried, the better they must agree. Cameras whose relative pose is known are searched as one body.
Each body is tried at the guesses of its cameras, and the most promising one is searched for all
over the range, until one is accepted. From then on the located cameras propose poses for the
others, by what both see in common and by the relative poses of the guess; also for those that have
been accepted, if they are elsewhere: where images and clouds agree better, all in all, is taken. If
no pose of a camera is accepted, it has not been found: the best of the rejected poses is never
taken.
"""

from concurrent.futures import Executor
from dataclasses import replace

from calibgraph.arrays import Array
from calibgraph.matching.structure.acceptance import least_z_score
from calibgraph.matching.structure.bodies import place_member, rigid_bodies
from calibgraph.matching.structure.box_search import CANDIDATES
from calibgraph.matching.structure.pose_refinement import Candidate
from calibgraph.matching.structure.pose_search import (
    ROLLS_RAD,
    PoseSearch,
    distinct,
    is_accepted,
    is_same_pose,
)
from calibgraph.model.findings import MatcherFindings
from calibgraph.progress import Progress

SEARCHES = 2  # per body
RETRY_EFFORT = 2
"""Factor on the candidates, and as far as memory allows on the windows, of a second search."""
TRIES = {1: len(ROLLS_RAD), 2: (1 + RETRY_EFFORT) * len(ROLLS_RAD)}
"""Amount of searching after a number of searches, in searches for one roll."""
ALONE = 1 / CANDIDATES  # the same of a single pose


Found = tuple[dict[str, Array], MatcherFindings]
"""(4, 4) T_camera_lidar of the cameras that are located; per camera the z-score of its body, where
that is far better than by chance and where it is not, in few frames the probability by chance, and
a camera that sees it elsewhere, while image and cloud of both are accepted where they are."""


class Locator:
    """The poses tried so far for each body of a rig; chooses the next one.

    Attributes:
        best: the candidate of the highest z-score of each body, by its lead's name.
        located: those that are accepted.
        contradictions: pairs of these that see each other elsewhere.
    """

    def __init__(self, search: PoseSearch, pool: Executor, progress: Progress) -> None:
        self._search, self._pool, self._progress = search, pool, progress
        search.report = self._report
        self._bodies = {next(iter(body)): body for body in rigid_bodies(search.rig)}
        self._searches = dict.fromkeys(self._bodies, 0)
        self._proposers: list[Candidate] = []  # that have proposed
        self._moves: set[tuple[str, str]] = set()  # a body, and the one by which it was moved
        self._near: dict[str, Candidate] = {}
        self.best: dict[str, Candidate] = {}
        self.located: dict[str, Candidate] = {}
        self.contradictions: list[tuple[Candidate, Candidate]] = []

    def locate(self) -> Found:
        """Locate all cameras of a rig, as far as time allows."""
        self._report("trying the guess")
        for name, body in self._bodies.items():
            guesses = distinct(place_member(body, n, self._search.guess[n]) for n in body)
            tried = list(self._pool.map(self._search.near, guesses))
            best = max(range(len(tried)), key=lambda k: tried[k].z_score)
            self._bodies[name], self._near[name] = guesses[best], tried[best]
            self._consider(name, tried[best], TRIES[1])
        shown = self._search.shows_something  # of the others, there is nothing to find
        self._bodies = {name: body for name, body in self._bodies.items() if shown(body)}
        steps = (
            self._propose,
            self._search_next,
            self._accept_guess,
            self._search_again,
        )
        while not self._search.out_of_time() and any(step() for step in steps):
            pass
        return self._result()

    def _consider(self, name: str, candidate: Candidate, tries: float) -> bool:
        """Keep a candidate if it is the best of its body, and locate the body if it is accepted."""
        looked_at = self._search.second_look(candidate, tries)
        if name not in self.best or candidate.z_score > self.best[name].z_score:
            self.best[name] = replace(candidate, chance=looked_at.chance)
        if not is_accepted(looked_at, tries):
            return False
        self.located[name] = looked_at
        return True

    def _propose(self) -> bool:
        """Let the best located body that has not proposed yet propose poses for all others."""
        new = [c for c in self.located.values() if c not in self._proposers]
        if not new or len(self._bodies) == 1:
            return False
        proposer = max(new, key=lambda candidate: candidate.z_score)
        self._proposers.append(proposer)
        self._report("trying what located cameras see")
        others = [name for name in self._bodies if name != next(iter(proposer.body))]
        for name in others:
            if self._search.out_of_time() or proposer not in self.located.values():
                break
            if name in self.located:
                self._compare(proposer, self.located[name])
            else:
                self._place_next_to(proposer, name)
        return True

    def _place_next_to(self, proposer: Candidate, name: str) -> None:
        """Try an unlocated body where a located one sees it, else where the guess has it."""
        proposed = self._search.seen_by(proposer.body, self._bodies[name])
        if proposed is not None and self._consider(name, self._search.at(proposed), ALONE):
            return
        guessed = self._search.as_in_guess(proposer.body, self._bodies[name])
        self._consider(name, self._search.from_afar(guessed), ALONE)

    def _compare(self, one: Candidate, two: Candidate) -> None:
        """Resolve two inconsistent bodies: keep the placement with the higher summed z-score."""
        seen_two = self._search.seen_by(one.body, two.body)
        if seen_two is None or is_same_pose(seen_two, two.body):
            return
        moved_two = self._search.at(seen_two)
        seen_one = self._search.seen_by(two.body, one.body)
        moved_one = None if seen_one is None else self._search.at(seen_one)
        if moved_one and moved_one.z_score + two.z_score > one.z_score + moved_two.z_score:
            self._replace(one, moved_one, by=two)
        else:
            self._replace(two, moved_two, by=one)

    def _replace(self, old: Candidate, new: Candidate, by: Candidate) -> None:
        """Move a body to where another one sees it, if it is accepted there, and only once.

        Else it remains where it is: what both see in common, as a part of the vehicle, may be no
        point of the scene, and its own image is no worse for it. But neither of them can be right
        without a doubt.
        """
        name, mover = next(iter(old.body)), next(iter(by.body))
        if (name, mover) not in self._moves:
            self._moves.add((name, mover))
            if self._consider(name, new, ALONE):
                return
        self.contradictions.append((old, by))

    def _search_next(self) -> bool:
        """Search for the most promising body that has not been searched for."""
        missing = [n for n in self._bodies if n not in self.located and not self._searches[n]]
        if not missing:
            return False
        self._search_for(max(missing, key=lambda name: self.best[name].z_score), effort=1)
        return True

    def _accept_guess(self) -> bool:
        """Accept a body near its guess, if a search found nothing better anywhere.

        The guess is unlikely to be the best of all tried poses by chance.
        """
        for name in self._missing():
            near = self._near[name]
            enough = near.z_score >= least_z_score(ALONE)  # no second look: tunnels are alike
            if enough and is_same_pose(near.body, self.best[name].body):
                self.located[name] = self._search.second_look(near, ALONE)
                return True
        return False

    def _search_again(self) -> bool:
        """Search again, with more effort, for a body that was not found."""
        again = [name for name in self._missing() if self._searches[name] < SEARCHES]
        if not self.located and len(self._bodies) > 1:
            again = self._last_hope(again)
        if not again:
            return False
        self._search_for(again[0], effort=RETRY_EFFORT)
        return True

    def _last_hope(self, again: list[str]) -> list[str]:
        """If no body of several was found, try the most promising one, once.

        A first search misses 5 % of the cameras that can be found (KITTI, 143 searches). Where it
        has missed all, there is hardly anything to find: one more search decides.
        """
        if not again or max(self._searches.values()) == SEARCHES:
            return []
        return [max(again, key=lambda name: self.best[name].z_score)]

    def _missing(self) -> list[str]:
        return [name for name in self._bodies if name not in self.located]

    def _search_for(self, name: str, effort: int) -> None:
        self._searches[name] += 1
        tries = TRIES[self._searches[name]]
        found = self._search.everywhere(self._bodies[name], effort, tries)
        self._consider(name, found, tries)

    def _report(self, what: str) -> None:
        total = SEARCHES * len(self._bodies)
        done = sum(SEARCHES if n in self.located else k for n, k in self._searches.items())
        self._progress(what, min(done, total), total)

    def _result(self) -> Found:
        T, missed, chance = dict[str, Array](), dict[str, float](), dict[str, float]()
        found, contradicted = dict[str, float](), dict[str, str]()
        for name, best in {**self.best, **self.located}.items():
            z_scores = dict.fromkeys(best.body, best.z_score)
            if name in self.located:
                T |= {member: camera.T_camera_lidar for member, camera in best.body.items()}
                found |= z_scores
            else:
                missed |= {member: max(0.0, z_score) for member, z_score in z_scores.items()}
            if best.chance is not None:
                chance |= dict.fromkeys(best.body, best.chance)
        for one, two in self.contradictions:
            if {one, two} <= {*self.located.values()}:  # and neither has moved since
                for each, other in ((one, two), (two, one)):
                    contradicted |= dict.fromkeys(each.body, next(iter(other.body)))
        return T, MatcherFindings(
            found=found, missed=missed, chance=chance, contradicted=contradicted
        )

"""The search for cameras without any guess: over all headings, by images and clouds."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array
from calibgraph.guessing.mounting import Forward, Mounting
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.structure.acceptance import least_z_score
from calibgraph.matching.structure.bodies import Body, lead, place
from calibgraph.matching.structure.frame_cache import FrameCache, load_camera_frames
from calibgraph.matching.structure.global_search import ALONE
from calibgraph.matching.structure.matcher import SEARCH_FRAMES
from calibgraph.matching.structure.pose_search import PoseSearch, SearchRange
from calibgraph.model.rig import Rig
from calibgraph.parallel import core_pool
from calibgraph.progress import Progress, no_progress

HEADINGS_DEG = tuple(range(0, 360, 30))
RANGE = SearchRange(float(np.radians(20.0)), 1.5)
"""About each heading: neighbours overlap."""


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """The best pose of a camera over all headings.

    Attributes:
        T_camera_lidar: (4, 4).
        z_score: agreement of images and clouds there, in standard deviations of chance agreement.
        needed: the z-score from which on that is no chance agreement.
        seen_by: the camera that placed it, where one that was found before sees the same.
    """

    T_camera_lidar: Array
    z_score: float
    needed: float
    seen_by: str | None = None

    @property
    def accepted(self) -> bool:
        """Whether the camera was found."""
        return self.z_score >= self.needed


def search_headings(
    dataset: Dataset,
    rig: Rig,
    cameras: Iterable[str],
    *,
    forward: Forward = "+x",
    seed: int = 0,
    progress: Progress = no_progress,
) -> dict[str, FoundCamera]:
    """Find cameras without a guess: only the lens is known, and that images are upright.

    One after another, over headings all round, each within 20 degrees and 1.5 m per axis of a level
    camera at the LiDAR. Those that are found place others that see the same.

    Raises:
        FileError: if an image or a cloud cannot be read.
    """
    names = list(cameras)
    lenses = {name: rig.cameras[name] for name in names}
    only = Rig(lidar=rig.lidar, cameras=lenses)
    found: dict[str, FoundCamera] = {}
    with core_pool() as cores:
        chosen = spread_out(dataset.frames, SEARCH_FRAMES)
        frames = load_camera_frames(FrameCache(), chosen, only, cores)
        search = PoseSearch(only, frames, RANGE, seed=seed, out_of_time=lambda: False)
        for index, name in enumerate(names):
            body = {name: lenses[name]}
            starts = [Mounting(float(deg)).T_camera_lidar(forward) for deg in HEADINGS_DEG]
            seen = _place_by_others(search, body, found)
            candidates = []
            for number, start in enumerate([] if seen else starts):
                done = index * len(starts) + number
                progress(f"searching all headings: {name}", done, len(names) * len(starts))
                candidates.append(search.with_roll(place(body, start), 0.0, effort=1))
            if seen is None:
                best = max(candidates, key=lambda candidate: candidate.z_score)
                T, needed = lead(best.body).T_camera_lidar, least_z_score(len(candidates))
                seen = FoundCamera(T, best.z_score, needed)
            found[name] = seen
    return found


def _place_by_others(
    search: PoseSearch, body: Body, found: dict[str, FoundCamera]
) -> FoundCamera | None:
    """The camera where one that was found sees it; None if that is not accepted."""
    for by, other in found.items():
        if not other.accepted:
            continue
        seen = search.seen_by({by: search.rig.cameras[by].moved_to(other.T_camera_lidar)}, body)
        if seen is None:
            continue
        candidate = search.at(seen)
        placed = FoundCamera(
            lead(candidate.body).T_camera_lidar, candidate.z_score, least_z_score(ALONE), by
        )
        if placed.accepted:
            return placed
    return None

"""Simulated correspondences of one scene, from one seed."""

from collections.abc import Mapping

import numpy as np

from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.rig import Rig
from calibgraph.simulation.matcher_errors import MatcherErrors
from calibgraph.simulation.simulated_matcher import SimulatedMatcher


def simulate_correspondences(
    rig: Rig,
    *,
    frames: int = 10,
    matches: int = 500,
    errors: MatcherErrors | Mapping[str, MatcherErrors] | None = None,
    depth_m: tuple[float, float] | None = (3.0, 50.0),
    seed: int = 0,
) -> Correspondences:
    """Draw correspondences as a matcher might find them.

    Args:
        rig: its extrinsics are the truth.
        frames: frames, seen by every camera.
        matches: correspondences per camera and frame.
        errors: the matcher's errors, of all cameras or per camera.
        depth_m: range of depths along the camera's axis, drawn uniformly in the logarithm; None for
            a street: a road 1.73 m below the LiDAR, walls to its left and right, objects in front
            of them, within the beams of a LiDAR, -25 to 15 degrees and up to 80 m.
        seed: of all draws.

    Raises:
        ValueError: if a camera sees too few points.
    """
    rng = np.random.default_rng(seed)
    matchers = matchers_of(rig, errors, seed)
    tables = [
        matcher.match(rng, name, frame, count=matches, depth_m=depth_m)
        for frame in range(frames)
        for name, matcher in matchers.items()
    ]
    return concatenate(tables)


def matchers_of(
    rig: Rig, errors: MatcherErrors | Mapping[str, MatcherErrors] | None, seed: int
) -> dict[str, SimulatedMatcher]:
    """A matcher per camera, numbered from 1: NumPy's generators of [seed, 0] and seed are equal."""
    return {
        name: SimulatedMatcher(camera, _errors_of(errors, name), [seed, number])
        for number, (name, camera) in enumerate(rig.cameras.items(), start=1)
    }


def _errors_of(
    errors: MatcherErrors | Mapping[str, MatcherErrors] | None, name: str
) -> MatcherErrors:
    if errors is None:
        return MatcherErrors()
    return errors if isinstance(errors, MatcherErrors) else errors[name]

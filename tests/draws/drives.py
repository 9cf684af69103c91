"""Correspondences of a drive in which extrinsics may change, frame by frame."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera, Rig
from calibgraph.simulation.correspondences import MatcherErrors, matchers_of

Rng = np.random.Generator

RANDOM_SHARE = 0.5
"""Share of the failed frames whose pixels are random."""


def simulate_drive(
    rig_at: Callable[[int], Rig],
    *,
    frames: int,
    matches: int = 500,
    errors: MatcherErrors | None = None,
    depth_m: tuple[float, float] = (3.0, 50.0),
    failed_share: float = 0.0,
    blind: Mapping[str, range] | None = None,
    seed: int = 0,
) -> Iterator[Correspondences]:
    """Draw the frames of a drive in which extrinsics may change, one table each.

    Args:
        rig_at: the true rig at a frame's number.
        frames: how many.
        matches: correspondences per camera and frame.
        errors: the matcher's errors.
        depth_m: range of depths along the camera's axis.
        failed_share: share of a camera's frames whose matches are wrong: half of these have random
            pixels, half the pixels of a pose that is off by 1 to 5 deg and 10 to 50 cm.
        blind: per camera, the frames without matches.
        seed: of all draws.
    """
    errors = errors or MatcherErrors()
    rng = np.random.default_rng(seed)
    nonsense = replace(errors, outlier_share=1.0, informative_confidence=False)
    matchers = matchers_of(rig_at(0), errors, seed)
    for frame in range(frames):
        tables = []
        for name, camera in rig_at(frame).cameras.items():
            if frame in (blind or {}).get(name, ()):
                continue
            failed, at_random = rng.random() < failed_share, rng.random() < RANDOM_SHARE
            seen = _displace(rng, camera) if failed and not at_random else camera
            made = nonsense if failed and at_random else errors
            matcher = matchers[name]  # its shared errors stay where the camera moves
            matcher.camera, matcher.errors = seen, made
            tables.append(matcher.match(rng, name, frame, count=matches, depth_m=depth_m))
        yield concatenate(tables)


def _displace(rng: Rng, camera: Camera) -> Camera:
    """The camera at a wrong pose."""
    axis, direction = rng.standard_normal((2, 3))
    turn = rng.uniform(1, 5) * axis / np.linalg.norm(axis)
    shift_m = rng.uniform(0.1, 0.5) * direction / np.linalg.norm(direction)
    T_delta = transform(Rotation.from_rotvec(turn, degrees=True), shift_m)
    return camera.moved_to(T_delta @ camera.T_camera_lidar)

"""The start of the joint solve, and whether every camera can be determined at all."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.model.config import Config, Terms
from calibgraph.model.geometry import invert, relative_transform
from calibgraph.model.rig import Rig
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock
from calibgraph.solver.objective import Transforms
from calibgraph.solver.preprocess import FILTERS
from calibgraph.solver.stage1 import CameraStage1, Stage1


def best_start(
    rig: Rig,
    blocks: Mapping[str, CameraBlock],
    stage1: Stage1,
    config: Config,
    *,
    terms: Terms,
    tied: Sequence[tuple[str, str]] = (),
) -> Transforms:
    """Per camera, (4, 4) T_camera_lidar from which the first pass starts.

    The best of Stage 1, the PnP of single frames and the rig's guess, by the mean Cauchy loss of
    all frames' correspondences at half the PnP threshold; with the terms ``stage1``, Stage 1
    itself. Cameras without correspondences start from a relative pose to one that has them: a
    measured one, or that of the guess to a camera that sees the same; else from their guess.

    Raises:
        CorrespondenceError: with the terms ``stage1``, if PnP failed in every frame of a camera.
    """
    start = {}
    for name, block in blocks.items():
        candidates = _candidates(name, rig, stage1.get(name), terms)
        start[name] = candidates[block.best_candidate(candidates, config.pnp_threshold_px / 2)]
    for _ in rig.cameras:  # the longest chain of relative poses
        for pair in rig.relative_poses:
            if pair.b in start:
                start.setdefault(pair.a, pair.T_a_b @ start[pair.b])
            if pair.a in start:
                start.setdefault(pair.b, invert(pair.T_a_b) @ start[pair.a])
        for one, other in (*tied, *((b, a) for a, b in tied)):
            if one in start:
                start.setdefault(other, _by_guess(rig, other, one) @ start[one])
    return {name: start.get(name, camera.T_camera_lidar) for name, camera in rig.cameras.items()}


def _by_guess(rig: Rig, to: str, of: str) -> Array:
    """(4, 4) T_to_of between two cameras by their guesses."""
    return relative_transform(rig.cameras[to].T_camera_lidar, rig.cameras[of].T_camera_lidar)


def _candidates(
    name: str, rig: Rig, estimate: CameraStage1 | None, terms: Terms
) -> list[NDArray[np.float64]]:
    """(4, 4) each: T_camera_lidar of Stage 1, of the rig, and of single frames."""
    T_hat = estimate.T_camera_lidar if estimate else None
    if terms == "stage1":
        if T_hat is None:
            raise CorrespondenceError(
                f"camera {name!r}: PnP failed in every frame, so there is no Stage-1 estimate; "
                "solve with other terms, or give more matches per frame",
                camera=name,
            )
        return [T_hat]
    stage1 = [] if T_hat is None else [T_hat]
    single = estimate.by_frame.values() if estimate else ()
    return [*stage1, rig.cameras[name].T_camera_lidar, *single]


def require_determined(
    rig: Rig,
    counts: Mapping[str, Mapping[str, int]],
    tied_by_images: Sequence[tuple[str, str]] = (),
    excluded: Sequence[str] = (),
) -> tuple[str, ...]:
    """Check that every camera has correspondences, or is tied to one that has.

    Args:
        rig: with its relative poses.
        counts: per camera, correspondences left after each filter.
        tied_by_images: the pairs of cameras that see enough in common.
        excluded: cameras that may have neither, as long as there are others.

    Returns:
        The cameras that have neither.

    Raises:
        CorrespondenceError: naming the first of them that may not.
    """
    tied = {name for name, count in counts.items() if count["capped"] >= MIN_MATCHES}
    for _ in rig.cameras:
        tied |= {p.a for p in rig.relative_poses if p.b in tied}
        tied |= {p.b for p in rig.relative_poses if p.a in tied}
        tied |= {name for pair in tied_by_images if tied & set(pair) for name in pair}
    held = tuple(name for name in counts if name not in tied)
    for name in held:
        if name in excluded and tied:
            continue
        count = counts[name]
        left = ", ".join(f"{count[filter]} {filter}" for filter in FILTERS)
        raise CorrespondenceError(
            f"camera {name!r} has {count['capped']} usable correspondences, at least "
            f"{MIN_MATCHES} are needed, or a relative pose to a camera that has them "
            f"(left after each filter: {left}): {_advice(count)}{_advice_for_others(tied)}",
            camera=name,
        )
    return held


def require_known(rig: Rig, names: Sequence[str]) -> None:
    """Check the cameras that the settings exclude.

    Raises:
        ValueError: if the rig lacks one.
    """
    for name in names:
        if name not in rig.cameras:
            known = ", ".join(rig.cameras)
            raise ValueError(f"excluded_cameras names {name!r}; the rig has {known}")


def _advice_for_others(tied: set[str]) -> str:
    """How to calibrate the cameras that have enough."""
    if not tied:
        return ""
    return (
        f"; to calibrate {', '.join(sorted(tied))} without it, take it out of the rig file, or "
        "name it in excluded_cameras of the settings"
    )


def _advice(count: Mapping[str, int]) -> str:
    """What to do about too few correspondences, by the filter that removed them."""
    if count["given"] < MIN_MATCHES:
        return (
            "none or few were found; check that its images show something, that the cloud lies "
            "where T_camera_lidar looks (p_camera = T_camera_lidar * p_lidar), and its name"
        )
    if count["projectable"] < MIN_MATCHES:
        return (
            "the points are not in front of it; check the direction of T_camera_lidar "
            "(p_camera = T_camera_lidar * p_lidar), its axes and its units"
        )
    if count["confident"] < MIN_MATCHES:
        return "their confidence is below confidence_min; lower it if they can be trusted"
    return "they crowd in few cells of the image; match more of it"

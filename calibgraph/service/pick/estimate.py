"""What picked pairs determine: PnP by several solvers, the joint solve, and what is weak."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calibgraph.model.geometry import pose_difference
from calibgraph.model.rig import Rig
from calibgraph.service.pick.joint import Influence, JointSolve, influences, solve_pairs
from calibgraph.service.pick.session import Pair, pixels_of, points_of, sigmas_of
from calibgraph.service.pick.solvers import MIN_PAIRS, Shape, SolverPose, poses_by_solver, shape_of
from calibgraph.trust.observability import weakest_direction

PAIRS_TO_FIND_A_WRONG_ONE = 6
"""Of a camera: with five, the four that are left beside a wrong one still fit almost anything."""


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """What the pairs of one camera give.

    Attributes:
        pairs: used, with their places in the session.
        solvers: the extrinsic of each PnP solver, the best first.
        spread: largest angle [deg] and distance [cm] between the solvers and the joint solve; None
            if there is none of either.
        influences: per used pair.
        warnings: what is wrong with the pairs, in words.
        weakest: the weakest direction in words, "" if not known.
    """

    pairs: tuple[tuple[int, Pair], ...]
    solvers: tuple[SolverPose, ...] = ()
    spread: tuple[float, float] | None = None
    influences: tuple[Influence, ...] = ()
    warnings: tuple[str, ...] = ()
    weakest: str = ""


@dataclass(frozen=True, eq=False)
class PickEstimate:
    """The joint solve, None if no camera is determined, and the estimate of each camera."""

    solve: JointSolve | None
    cameras: Mapping[str, CameraEstimate] = field(default_factory=dict)


def estimate_from_pairs(rig: Rig, pairs: Sequence[Pair]) -> PickEstimate:
    """Estimate all cameras that the pairs determine.

    Args:
        rig: lenses and measured relative poses; its extrinsics are not used for cameras with pairs.
        pairs: all, in the session's order; those that are not used are left out.
    """
    numbered = {
        name: tuple((i, p) for i, p in enumerate(pairs) if p.used and p.camera == name)
        for name in rig.cameras
    }
    used = {name: [pair for _, pair in some] for name, some in numbered.items()}
    shapes = {name: shape_of(points_of(some)) for name, some in used.items() if some}
    solvers = {name: _solvers(rig, name, some, shapes) for name, some in used.items()}
    determined = [name for name in rig.cameras if solvers[name]]
    if not determined:
        return PickEstimate(None, {
            name: CameraEstimate(some, warnings=tuple(_warnings(used[name], shapes.get(name))))
            for name, some in numbered.items()
        })  # fmt: skip
    start = _part_of_rig(rig, determined).moved_to(
        {name: solvers[name][0].T_camera_lidar for name in determined}
    )
    joint_pairs = {name: used[name] for name in determined}
    solve = solve_pairs(start, joint_pairs)
    changes = influences(solve, joint_pairs)
    return PickEstimate(solve, {
        name: _camera(solve, name, some, solvers=solvers[name],
                      changes=tuple(changes.get(name, ())), shapes=shapes)
        for name, some in numbered.items()
    })  # fmt: skip


def _solvers(
    rig: Rig, name: str, pairs: Sequence[Pair], shapes: Mapping[str, tuple[Shape, float]]
) -> tuple[SolverPose, ...]:
    if len(pairs) < MIN_PAIRS or shapes[name][0] == "line":
        return ()
    flat = shapes[name][0] == "plane"
    found = poses_by_solver(
        rig.cameras[name], points_of(pairs), pixels_of(pairs), sigmas_of(pairs), flat=flat
    )
    return tuple(pose for pose in found if np.isfinite(pose.median_px))


def _part_of_rig(rig: Rig, names: Sequence[str]) -> Rig:
    """The rig of some cameras, with the relative poses between them."""
    poses = tuple(pose for pose in rig.relative_poses if {pose.a, pose.b} <= {*names})
    return rig.model_copy(
        update={"cameras": {name: rig.cameras[name] for name in names}, "relative_poses": poses}
    )


def _camera(
    solve: JointSolve,
    name: str,
    numbered: tuple[tuple[int, Pair], ...],
    *,
    solvers: tuple[SolverPose, ...],
    changes: tuple[Influence, ...],
    shapes: Mapping[str, tuple[Shape, float]],
) -> CameraEstimate:
    pairs = [pair for _, pair in numbered]
    warnings = _warnings(pairs, shapes.get(name))
    if not solvers:
        return CameraEstimate(numbered, warnings=tuple(warnings))
    T, covariance = solve.rig.T_camera_lidar[name], solve.covariance_of(name)
    differences = np.array([pose_difference(pose.T_camera_lidar, T) for pose in solvers])
    wrong = [i for (i, _), change in zip(numbered, changes, strict=True) if change.suspicious]
    for place in wrong:
        warnings.append(f"pair {place + 1} disagrees with all others: look at it again")
    if covariance is None:
        warnings.append("a direction is free: pick points farther from each other")
    return CameraEstimate(
        numbered,
        solvers,
        (float(differences[:, 0].max()), float(differences[:, 1].max())),
        changes,
        tuple(warnings),
        "" if covariance is None else weakest_direction(covariance),
    )


def _warnings(pairs: Sequence[Pair], shape: tuple[Shape, float] | None) -> list[str]:
    """What is wrong with the pairs of a camera, whatever their solution."""
    if not pairs or shape is None:
        return []
    kind, off_m = shape
    words = []
    if len(pairs) < MIN_PAIRS:
        missing = MIN_PAIRS - len(pairs)
        words.append(f"too few pairs: {missing} more {'is' if missing == 1 else 'are'} needed")
    elif kind == "line":
        words.append(
            f"all points lie on one line (within {100 * off_m:.1f} cm): pick some beside it"
        )
    elif kind == "plane":
        words.append(
            f"all points lie in one plane (within {100 * off_m:.1f} cm), for which there may be "
            "two solutions: pick something in front of it or behind it"
        )
    if MIN_PAIRS <= len(pairs) < PAIRS_TO_FIND_A_WRONG_ONE:
        words.append(
            f"{len(pairs)} pairs cannot show which of them is wrong: pick at least "
            f"{PAIRS_TO_FIND_A_WRONG_ONE}"
        )
    return words

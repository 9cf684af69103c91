"""The error bar of a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from calibgraph import Config, Correspondences, RelativePose, Rig, concatenate, solve
from calibgraph.model.geometry import relative_transform
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.evidence import Evidence
from tests.trust.conftest import simulated

Array = NDArray[np.float64]


def tied(rig: Rig, *, rotation_deg: float, translation_m: float) -> Rig:
    """With a measured relative pose of right and left."""
    T = rig.T_camera_lidar
    measured = RelativePose(
        a="right",
        b="left",
        T_a_b=relative_transform(T["right"], T["left"]),
        rotation_sigma_rad=np.radians(rotation_deg),
        translation_sigma_m=translation_m,
    )
    return rig.model_copy(update={"relative_poses": (measured,)})


def with_frames_of_right(table: Correspondences, frames: int) -> Correspondences:
    """All of left's correspondences, and those of right in the first frames."""
    right = table.of_camera("right")
    return concatenate([table.of_camera("left"), right.select(right.frame < frames)])


def test_the_covariance_has_full_rank_with_fewer_frames_than_numbers(mixed_rig: Rig) -> None:
    result = solve(mixed_rig, simulated(mixed_rig, frames=5))
    assert result.joint_covariance is not None
    assert np.linalg.eigvalsh(result.joint_covariance)[0] > 0


@pytest.mark.parametrize("frames", [1, 2, 4])
def test_the_error_bar_of_few_frames_is_wide(pair: Rig, frames: int) -> None:
    """In the mean over its axes at least as the root of their number; and never a PASS."""
    few, many = (solve(pair, simulated(pair, frames=n)) for n in (frames, 40))
    for name in pair.cameras:
        narrow, wide = (result.sigmas(name) for result in (many, few))
        assert narrow is not None and wide is not None
        for one, other in zip(narrow, wide, strict=True):
            assert np.exp(np.log(other / one).mean()) > 0.8 * np.sqrt(40 / frames)
    assert few.verdict.status != "PASS"
    assert any("mostly a default" in reason for reason in few.verdict.reasons)


def test_the_sigmas_of_a_relative_pose_are_in_the_error_bar(pair: Rig) -> None:
    """Of a camera without correspondences, they are nearly all of it."""
    table = simulated(pair, frames=10).of_camera("left")
    result = solve(tied(pair, rotation_deg=2.9, translation_m=0.3), table)
    sigmas = result.sigmas("right")
    assert sigmas is not None
    assert sigmas[0] == pytest.approx([2.9] * 3, rel=0.01)
    assert sigmas[1] == pytest.approx([30] * 3, rel=0.1)
    of_left = result.sigmas("left")
    assert of_left is not None and of_left[0].max() < 0.1


def test_a_camera_with_few_frames_has_a_wider_error_bar_than_one_with_many(pair: Rig) -> None:
    result = solve(pair, with_frames_of_right(simulated(pair, frames=40), 6))
    left, right = (result.sigmas(name) for name in ("left", "right"))
    assert left is not None and right is not None
    assert (right[0] > 1.5 * left[0]).all()


def test_an_error_shared_by_all_frames_moves_a_camera_without_correspondences_with_its_pair(
    pair: Rig,
) -> None:
    rig = tied(pair, rotation_deg=0.01, translation_m=0.001)
    table = simulated(pair, frames=10).of_camera("left")
    findings = table.metadata | {"systematic_rotation_rad": 0.01, "systematic_translation_m": 0.1}
    table = table.with_metadata(findings)
    evidence = Evidence(solve_joint(rig, table), guess=rig)
    covariance = evidence.joint_covariance
    assert covariance is not None
    sigmas = np.sqrt(np.diag(covariance)).reshape(-1, 6)
    assert sigmas[1, :3] == pytest.approx([0.01] * 3, rel=0.05)  # not more: the pair is rigid
    assert sigmas[1, 3:] == pytest.approx([0.1] * 3, rel=0.05)


@pytest.mark.parametrize(("turned_deg", "groups"), [(0, [("left", "right")]), (30, None)])
def test_a_relative_pose_ties_cameras_unless_matches_contradict_it(
    pair: Rig, turned_deg: float, groups: list[tuple[str, ...]] | None
) -> None:
    measured = tied(pair, rotation_deg=0.02, translation_m=0.003).relative_poses[0]
    turn = gtsam.Pose3(gtsam.Rot3.Ry(np.radians(turned_deg)), np.zeros(3)).matrix()
    measured = measured.model_copy(update={"T_a_b": measured.T_a_b @ turn})
    rig = pair.model_copy(update={"relative_poses": (measured,)})
    seen: list[Sequence[Sequence[str]]] = []

    def measure(covariances: Mapping[str, Array], found: Sequence[Sequence[str]]) -> dict[str, Any]:
        seen.append(found)
        return {}

    evidence = Evidence(solve_joint(rig, simulated(rig, frames=10), Config()), rig, measure)
    assert not evidence.posteriors
    assert seen == [groups or [("left",), ("right",)]]

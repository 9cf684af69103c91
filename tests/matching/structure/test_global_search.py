"""The global search: its decisions with fake refinements; on the sample see test_matcher.py."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import calibgraph
from calibgraph import Camera, Rig, StructureMatcher
from calibgraph.matching.structure import global_search, proposals
from calibgraph.matching.structure.global_search import SearchRange, locate_cameras
from calibgraph.matching.structure.pose_refinement import ACCEPTED, CameraFrames, Candidate
from calibgraph.progress import no_progress
from tests.conftest import SAMPLE
from tests.matching.structure.data import never

NAMES = ("front_left", "front_right")


def a_metre_off(T_camera_lidar: np.ndarray) -> np.ndarray:
    T = T_camera_lidar.copy()
    T[0, 3] += 1.0
    return T


def key(T_camera_lidar: np.ndarray) -> tuple[float, ...]:
    """The translation [mm], as a key."""
    return tuple((1000 * T_camera_lidar[:3, 3]).round().tolist())


def fake_search(
    monkeypatch: pytest.MonkeyPatch,
    z_scores: dict[tuple[float, ...], float],
    searched: dict[str, np.ndarray],
) -> list[str]:
    """Refinements that stay where they are, with given z-scores (else 1), and given search results.

    Returns the names of the cameras in the order in which they are searched.
    """
    searches: list[str] = []

    def refine(frames: CameraFrames, camera: Camera) -> Candidate:
        z_score = z_scores.get(key(camera.T_camera_lidar), 1.0)
        return Candidate(camera, z_score, z_score >= ACCEPTED)

    def search_range(
        search: global_search._CameraSearch, counts: dict[str, int], name: str
    ) -> Candidate:
        searches.append(name)
        return search.first_accepted(name, [[searched[name]]])

    monkeypatch.setattr(global_search, "refine", refine)
    monkeypatch.setattr(global_search._CameraSearch, "search_range", search_range)
    return searches


def locate_without_images(rig: Rig) -> dict[str, Candidate]:
    with ThreadPoolExecutor(1) as pool:
        frames = {name: CameraFrames([], [], pool) for name in rig.cameras}
        return locate_cameras(
            rig,
            frames,
            SearchRange(0.3, 1.5),
            seed=0,
            out_of_time=never,
            pool=pool,
            progress=no_progress,
        )


def test_the_best_of_the_lengths_that_overlap_leaves_open_is_taken(
    truth: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Transforms that are right but for the length of their translation may be accepted too."""
    rig = Rig(cameras={name: truth.cameras[name] for name in NAMES})
    right = rig.T_camera_lidar[NAMES[1]] @ np.linalg.inv(rig.T_camera_lidar[NAMES[0]])
    right[:3, 3] *= 1.25 / np.linalg.norm(right[:3, 3])
    goal = right @ rig.T_camera_lidar[NAMES[0]]
    direction = right.copy()
    direction[:3, 3] /= 1.25

    def refine(frames: CameraFrames, camera: Camera) -> Candidate:
        if np.array_equal(camera.T_camera_lidar, rig.T_camera_lidar[NAMES[0]]):
            return Candidate(camera, 50.0, True)
        if np.array_equal(camera.T_camera_lidar, rig.T_camera_lidar[NAMES[1]]):
            return Candidate(camera, 5.0, False)
        off = np.linalg.norm((camera.T_camera_lidar - goal)[:3, 3])
        z_score = 80.0 if off < 0.1 else 18.0 if 0.4 < off < 0.9 else 5.0
        return Candidate(camera, z_score, z_score >= ACCEPTED)

    monkeypatch.setattr(global_search, "refine", refine)
    monkeypatch.setattr(proposals, "relative_pose_up_to_scale", lambda *_, **__: direction)
    found = locate_without_images(rig)[NAMES[1]]
    assert found.z_score == 80.0
    np.testing.assert_allclose(found.camera.T_camera_lidar, goal, atol=1e-9)


@pytest.mark.parametrize(
    ("near", "elsewhere", "taken"),
    [
        (12.3, 19.0, "elsewhere"),
        (14.9, 17.2, "near"),
        (11.5, 9.0, "near"),
        (11.5, 12.0, "none"),
        (8.4, 6.3, "near"),
        (7.0, 5.0, "none"),
    ],
)
def test_a_low_z_score_near_the_guess_is_accepted_after_a_search_without_rival(
    truth: Rig, monkeypatch: pytest.MonkeyPatch, near: float, elsewhere: float, taken: str
) -> None:
    rig = Rig(cameras={"left": truth.cameras["left"]})
    guess = rig.T_camera_lidar["left"]
    other = a_metre_off(guess)
    z_scores = {key(guess): near, key(other): elsewhere}
    searches = fake_search(monkeypatch, z_scores, {"left": other})
    found = locate_without_images(rig)["left"]
    assert searches[0] == "left"
    assert found.accepted == (taken != "none")
    if found.accepted:
        T = guess if taken == "near" else other
        np.testing.assert_allclose(found.camera.T_camera_lidar, T, atol=1e-9)


def test_proposals_of_other_cameras_come_before_a_poor_guess(
    truth: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One camera's guess is refined to a low z-score, its search finds less; the other is found."""
    rig = Rig(cameras={name: truth.cameras[name] for name in NAMES})
    first, second = (rig.T_camera_lidar[name] for name in NAMES)
    found_first, nowhere = a_metre_off(first), a_metre_off(a_metre_off(second))
    proposed = second @ np.linalg.inv(first) @ found_first
    z_scores = {key(second): 8.4, key(found_first): 19.0, key(proposed): 22.0}
    fake_search(monkeypatch, z_scores, {NAMES[0]: found_first, NAMES[1]: nowhere})
    monkeypatch.setattr(proposals, "relative_pose_up_to_scale", lambda *_, **__: None)
    found = locate_without_images(rig)
    assert found[NAMES[0]].z_score == 19.0
    assert found[NAMES[1]].accepted
    np.testing.assert_allclose(found[NAMES[1]].camera.T_camera_lidar, proposed, atol=1e-9)


def test_no_pose_is_tried_after_the_time_limit(truth: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[Camera] = []

    def refine(frames: CameraFrames, camera: Camera) -> Candidate:
        tried.append(camera)
        return Candidate(camera, 0.0, False)

    monkeypatch.setattr(global_search, "refine", refine)
    monkeypatch.setattr(global_search, "search_box", lambda *_, **__: [np.eye(4)] * 50)
    rig = Rig(cameras={"left": truth.cameras["left"]})
    data = calibgraph.load_dataset(SAMPLE, rig).select("0")
    start = StructureMatcher().locate(
        data, rig, out_of_time=lambda: len(tried) > 3, progress=no_progress
    )
    assert len(tried) == 4  # the guess, and three poses
    assert "left" in start.findings.missed

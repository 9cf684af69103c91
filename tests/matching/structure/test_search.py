"""The global search of the matcher `structure`: its parts, and the sample from far away."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import Camera, Dataset, Rig, StructureMatcher
from calibgraph.matching.structure import global_search as locate
from calibgraph.matching.structure.box_search import Box, search_box
from calibgraph.matching.structure.correlation_maps import Responses
from calibgraph.matching.structure.cross_entropy import maximize
from calibgraph.matching.structure.epipolar import overlap_pose
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.windows import Cloud, cut_windows
from calibgraph.rounds import match_in_rounds
from tests.conftest import SAMPLE, Call, make_camera


@pytest.fixture(scope="module")
def truth() -> Rig:
    return calibgraph.load_rig(SAMPLE / "reference.yaml")


def far_from(truth: Rig, seed: int, degrees: float = 20.0, metres: float = 1.5) -> Rig:
    return calibgraph.perturb(
        truth, rotation_deg=degrees, translation_m=metres, seed=seed, uniform=True
    )


def never() -> bool:
    return False


def silent(what: str, done: int, total: int) -> None:
    pass


class TestParts:
    def test_cross_entropy_finds_a_tilted_maximum(self) -> None:
        rng = np.random.default_rng(0)
        A = rng.standard_normal((6, 6)) + 3 * np.eye(6)
        top = rng.uniform(-0.5, 0.5, 6)
        found, value = maximize(
            lambda points: -(((points - top) @ A) ** 2).sum(axis=1),
            start=np.zeros(6),
            spread=np.ones(6),
            limit=np.full(6, 2.0),
            samples=200,
            steps=30,
            rng=rng,
        )
        np.testing.assert_allclose(found, top, atol=0.01)  # 30 steps, each about 0.8 as wide
        assert value > -0.01

    def test_a_displacement_leads_to_its_pose(self) -> None:
        box = Box(make_camera((0.3, 0.1, -0.1)).T_camera_lidar, 0.3, 1.5)
        displacements = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 6))
        for displacement, T in zip(displacements, box.poses(displacements), strict=True):
            np.testing.assert_allclose(box.displacement(T), displacement, atol=1e-12)
        np.testing.assert_array_equal(box.excess(displacements), np.zeros(5))
        assert box.excess(np.full((1, 6), 0.6)) == pytest.approx(3.0)  # three angles, twice as far

    def test_the_search_finds_where_the_maps_agree(self) -> None:
        """Groups whose maps have one peak each, where the true pose puts them, and false ones."""
        rng = np.random.default_rng(1)
        points = rng.uniform([5, -15, -2], [40, 15, 4], (600, 3))
        true = make_camera((0.3, 0.1, -0.1)).T_camera_lidar
        step, origin, shape = np.radians(0.6), np.radians([-41.0, -15.0]), (50, 137)
        seen = points @ true[:3, :3].T + true[:3, 3]
        right = np.arctan2(seen[:, 0], seen[:, 2])
        down = np.arctan2(seen[:, 1], np.hypot(seen[:, 0], seen[:, 2]))
        place = (np.column_stack([right, down]) - origin) / step
        wrong = rng.random(600) < 0.5
        place[wrong] = rng.uniform(0, shape[::-1], (np.count_nonzero(wrong), 2))
        v, u = np.mgrid[: shape[0], : shape[1]]
        squares = (u - place[:, 0, None, None]) ** 2 + (v - place[:, 1, None, None]) ** 2
        maps = np.exp(-0.5 * squares / 2.0**2).astype(np.float32)
        maps -= maps.mean(axis=(1, 2), keepdims=True)
        responses = Responses(maps, points, origin, step)
        guess = Box(true, np.radians(20), 1.5).poses(rng.uniform(-1, 1, (1, 6)) * 0.3)[0]
        found = search_box(responses, Box(guess, np.radians(20), 1.5), seed=0)
        off = Box(true, 1.0, 1.0).displacement(found[0])
        assert np.abs(off[:3]).max() < np.radians(0.6)  # a step of the maps
        assert np.abs(off[3:]).max() < 0.15  # a step at 15 m

    def test_a_window_behind_a_silhouette_is_drawn_forward(self) -> None:
        """A post at 5 m before a wall at 20 m: no window has members at both distances."""
        angles = np.radians(np.arange(-6, 6, 0.2))
        rays = np.array([[1.0, np.tan(a), np.tan(e)] for a, e in itertools.product(angles, angles)])
        post = np.abs(rays[:, 1]) < np.tan(np.radians(1.0))
        rays *= np.where(post, 5.0, 20.0)[:, None]
        windows = cut_windows(
            rays,
            np.ones(len(rays)),
            spacing_rad=np.radians(0.2),
            stride_spacings=2.0,
            most=10_000,
            keep_linear=False,
        )
        at_edge = ~windows.front.all(axis=1)
        assert np.count_nonzero(at_edge) > 20
        assert windows.rays_m[at_edge][..., 0].max() < 5.2
        np.testing.assert_allclose(  # along their own rays
            windows.rays_m / np.linalg.norm(windows.rays_m, axis=2, keepdims=True),
            (rays / np.linalg.norm(rays, axis=1, keepdims=True))[windows.members],
        )

    def test_a_cloud_knows_whether_it_was_seen_from_its_origin(self) -> None:
        cloud = calibgraph.load_dataset(SAMPLE).frames[0].load_cloud()
        assert Cloud.of(cloud).from_origin
        cloud[:, 2] += 2.0  # as in a frame on the ground
        moved, camera = Cloud.of(cloud), make_camera((1.0, 2.0, 3.0))
        assert not moved.from_origin
        np.testing.assert_allclose(moved.viewpoint_m(camera), [1.0, 2.0, 3.0], atol=1e-12)


class TestSample:
    @pytest.mark.slow
    def test_it_is_found_from_far_away(self, truth: Rig) -> None:
        far = far_from(truth, seed=1)
        rig = Rig(cameras={name: far.cameras[name] for name in ("front_left", "left")})
        data = calibgraph.load_dataset(SAMPLE, rig)
        start = StructureMatcher().locate(data, rig, out_of_time=never, progress=silent)
        assert start.findings.found.keys() == rig.cameras.keys()
        assert start.first_round == 3
        for name, error in calibgraph.evaluate(start.rig, truth).cameras.items():
            assert error.rotation_error_deg < 0.7, name  # what the next round reaches
            assert error.translation_error_cm < 20, name

    @pytest.mark.slow
    def test_the_same_seed_finds_the_same(self, truth: Rig) -> None:
        far = far_from(truth, seed=1)
        rig = Rig(cameras={"front_left": far.cameras["front_left"]})
        data = calibgraph.load_dataset(SAMPLE, rig).select("0:2")
        one, two = (
            StructureMatcher().locate(data, data.rig, out_of_time=never, progress=silent)
            for _ in range(2)
        )
        for name, T in one.rig.T_camera_lidar.items():
            np.testing.assert_array_equal(T, two.rig.T_camera_lidar[name])

    def test_a_known_relative_pose_helps_a_camera(self, truth: Rig) -> None:
        """One camera has its true guess; the other's is beyond the range, its place in it known."""
        names = ["front_left", "front_right"]
        poses = {n: truth.cameras[n].T_camera_lidar for n in names}
        pair = calibgraph.RelativePose(
            a=names[1],
            b=names[0],
            T_a_b=poses[names[1]] @ np.linalg.inv(poses[names[0]]),
            rotation_sigma_rad=0.001,
            translation_sigma_m=0.002,
        )
        turned = np.eye(4)
        turned[:3, :3] = cv2.Rodrigues(np.radians([0.0, 60.0, 0.0]))[0]
        cameras = {n: truth.cameras[n] for n in names}
        cameras[names[1]] = cameras[names[1]].moved_to(turned @ poses[names[1]])
        rig = Rig(cameras=cameras, relative_poses=(pair,))
        data = calibgraph.load_dataset(SAMPLE, rig).select("0:3")
        start = StructureMatcher().locate(data, rig, out_of_time=never, progress=silent)
        assert names[1] in start.findings.found
        error = calibgraph.evaluate(start.rig, truth).cameras[names[1]]
        assert error.rotation_error_deg < 0.7

    def test_cameras_that_see_the_same_know_how_they_stand(self, truth: Rig) -> None:
        frames = calibgraph.load_dataset(SAMPLE).select("0:3").frames
        lenses = {name: c.moved_to(np.eye(4)) for name, c in truth.cameras.items()}
        grays = {
            name: [cv2.cvtColor(f.load_image(name, camera), cv2.COLOR_BGR2GRAY) for f in frames]
            for name, camera in lenses.items()
        }
        names = ("front_left", "front_right")
        found = overlap_pose(*(lenses[n] for n in names), *(grays[n] for n in names), seed=0)
        left, right = (truth.cameras[n].T_camera_lidar for n in names)
        T = right @ np.linalg.inv(left)
        assert found is not None
        assert np.degrees(np.linalg.norm(cv2.Rodrigues(found[:3, :3] @ T[:3, :3].T)[0])) < 0.5
        assert found[:3, 3] @ T[:3, 3] > 0.99 * np.linalg.norm(T[:3, 3])
        apart = ("front_right", "left")
        for pair in (apart, apart[::-1]):
            at, of = (lenses[n] for n in pair), (grays[n] for n in pair)
            assert overlap_pose(*at, *of, seed=0) is None

    @pytest.mark.slow
    def test_a_camera_is_found_by_what_it_sees_of_another(
        self, truth: Rig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """One camera has its true guess; the other's is far off, and no search finds it."""
        monkeypatch.setattr(locate, "search_box", lambda *_, **__: [])
        far, names = far_from(truth, seed=1), ("front_left", "front_right")
        rig = Rig(cameras={names[0]: truth.cameras[names[0]], names[1]: far.cameras[names[1]]})
        data = calibgraph.load_dataset(SAMPLE, rig).select("0:3")
        start = StructureMatcher().locate(data, rig, out_of_time=never, progress=silent)
        assert names[1] in start.findings.found
        error = calibgraph.evaluate(start.rig, truth).cameras[names[1]]
        assert error.rotation_error_deg < 0.7

    def test_of_the_lengths_that_views_leave_open_the_best_is_taken(
        self, truth: Rig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Transforms that are right but for the length of their translation may be accepted too."""
        names = ("front_left", "front_right")
        rig = Rig(cameras={name: truth.cameras[name] for name in names})
        right = rig.T_camera_lidar[names[1]] @ np.linalg.inv(rig.T_camera_lidar[names[0]])
        right[:3, 3] *= 1.25 / np.linalg.norm(right[:3, 3])
        goal = right @ rig.T_camera_lidar[names[0]]
        direction = right.copy()
        direction[:3, 3] /= 1.25

        def settle(view: locate.View, camera: Camera) -> locate.Found:
            if np.array_equal(camera.T_camera_lidar, rig.T_camera_lidar[names[0]]):
                return locate.Found(camera, 50.0, True)
            if np.array_equal(camera.T_camera_lidar, rig.T_camera_lidar[names[1]]):
                return locate.Found(camera, 5.0, False)
            off = np.linalg.norm((camera.T_camera_lidar - goal)[:3, 3])
            contrast = 80.0 if off < 0.1 else 18.0 if 0.4 < off < 0.9 else 5.0
            return locate.Found(camera, contrast, contrast >= locate.ACCEPTED)

        monkeypatch.setattr(locate, "settle", settle)
        monkeypatch.setattr(locate, "overlap_pose", lambda *_, **__: direction)
        found = located(rig)[names[1]]
        assert found.contrast == 80.0
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
    def test_what_the_guess_settles_to_is_judged_after_a_search(
        self, truth: Rig, monkeypatch: pytest.MonkeyPatch, near: float, elsewhere: float, taken: str
    ) -> None:
        rig = Rig(cameras={"left": truth.cameras["left"]})
        guess = rig.T_camera_lidar["left"]
        other = moved(guess)
        contrast = {place(guess): near, place(other): elsewhere}
        searches = fake_search(monkeypatch, contrast, {"left": other})
        found = located(rig)["left"]
        assert searches[0] == "left"
        assert found.accepted == (taken != "none")
        if found.accepted:
            T = guess if taken == "near" else other
            np.testing.assert_allclose(found.camera.T_camera_lidar, T, atol=1e-9)

    def test_another_camera_is_asked_before_a_poor_guess_is_taken(
        self, truth: Rig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The guess of one settles poorly, and its search finds less; the other is found."""
        names = ("front_left", "front_right")
        rig = Rig(cameras={name: truth.cameras[name] for name in names})
        first, second = (rig.T_camera_lidar[name] for name in names)
        found_first, nowhere = moved(first), moved(moved(second))
        proposed = second @ np.linalg.inv(first) @ found_first
        contrast = {place(second): 8.4, place(found_first): 19.0, place(proposed): 22.0}
        fake_search(monkeypatch, contrast, {names[0]: found_first, names[1]: nowhere})
        monkeypatch.setattr(locate, "overlap_pose", lambda *_, **__: None)
        found = located(rig)
        assert found[names[0]].contrast == 19.0
        assert found[names[1]].accepted
        np.testing.assert_allclose(found[names[1]].camera.T_camera_lidar, proposed, atol=1e-9)

    def test_what_is_not_found_fails(
        self, truth: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(locate, "SEARCHES", 1)
        rig = Rig(cameras={name: truth.cameras[name] for name in ("front_left", "left")})
        data = with_noise(calibgraph.load_dataset(SAMPLE, rig).select("0:2"), tmp_path)
        start = StructureMatcher().locate(data, rig, out_of_time=never, progress=silent)
        assert start.findings.missed.keys() == {"left"}
        np.testing.assert_allclose(
            start.rig.T_camera_lidar["left"], truth.T_camera_lidar["left"], atol=1e-12
        )
        assert start.first_round == 0

    @pytest.mark.slow
    def test_what_is_not_found_fails_in_later_solves(
        self, truth: Rig, tmp_path: Path, call: Call
    ) -> None:
        """A search of so small a range, so far off, finds nothing."""
        rig, table = tmp_path / "rig.yaml", tmp_path / "matches.parquet"
        far_from(truth, seed=1).save(rig)
        near = ("--search-deg", "0.5", "--search-m", "0.05", "--frames", "0:2")
        code, _, err = call("match", SAMPLE, "--rig", rig, "--out", table, *near)
        assert code == 1 and "not found: " in err, err
        missed = set(calibgraph.load_correspondences(table).metadata["missed"])
        assert missed and missed <= set(truth.cameras)
        code, _, err = call("solve", rig, table, "--out", tmp_path / "out")
        assert code == 1
        assert "no pose within the matcher's range explains the images" in err

    def test_no_pose_is_tried_when_time_is_over(
        self, truth: Rig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        settled: list[Camera] = []

        def settle(view: locate.View, camera: Camera) -> locate.Found:
            settled.append(camera)
            return locate.Found(camera, 0.0, False)

        monkeypatch.setattr(locate, "settle", settle)
        monkeypatch.setattr(locate, "search_box", lambda *_, **__: [np.eye(4)] * 50)
        rig = Rig(cameras={"left": truth.cameras["left"]})
        data = calibgraph.load_dataset(SAMPLE, rig).select("0")
        start = StructureMatcher().locate(
            data, rig, out_of_time=lambda: len(settled) > 3, progress=silent
        )
        assert len(settled) == 4  # the guess, and three poses
        assert "left" in start.findings.missed

    def test_no_time_makes_it_partial(self, truth: Rig) -> None:
        data = calibgraph.load_dataset(SAMPLE).select("0:2")
        matcher = StructureMatcher(search_deg=None, search_m=None, levels=LEVELS[:3])
        result = calibgraph.calibrate(data, matcher=matcher, time_limit_s=1e-3)
        assert len(result.rounds) == 1
        assert result.verdict.status in ("WARN", "FAIL")
        assert any(
            "partial: there was no time for 2 rounds of matching" in reason
            for reason in result.verdict.reasons
        )

    def test_with_time_enough_nothing_is_said(self) -> None:
        data = calibgraph.load_dataset(SAMPLE).select("0:2")
        matcher = StructureMatcher(search_deg=None, search_m=None, levels=LEVELS[:1])
        matched = match_in_rounds(data, matcher=matcher, time_limit_s=600, progress=silent)
        assert not matched.out_of_time and matched.missed_rounds == 0


def moved(T_camera_lidar: np.ndarray) -> np.ndarray:
    """A pose a metre off."""
    T = T_camera_lidar.copy()
    T[0, 3] += 1.0
    return T


def place(T_camera_lidar: np.ndarray) -> tuple[float, ...]:
    """Its translation [mm], to look it up."""
    return tuple((1000 * T_camera_lidar[:3, 3]).round().tolist())


def fake_search(
    monkeypatch: pytest.MonkeyPatch,
    contrast: dict[tuple[float, ...], float],
    found: dict[str, np.ndarray],
) -> list[str]:
    """Poses settle where they are, with contrasts as said (else 1); what searches try, as said."""
    searches: list[str] = []

    def settle(view: locate.View, camera: Camera) -> locate.Found:
        value = contrast.get(place(camera.T_camera_lidar), 1.0)
        return locate.Found(camera, value, value >= locate.ACCEPTED)

    def search(seeker: locate._Seeker, counts: dict[str, int], name: str) -> locate.Found:
        searches.append(name)
        return seeker._first(name, [[found[name]]])

    monkeypatch.setattr(locate, "settle", settle)
    monkeypatch.setattr(locate._Seeker, "search", search)
    return searches


def located(rig: Rig) -> dict[str, locate.Found]:
    """Search without images."""
    views = {name: locate.View([], []) for name in rig.cameras}
    within = locate.Range(0.3, 1.5)
    with ThreadPoolExecutor(1) as pool:
        return locate.locate(
            rig, views, within, seed=0, out_of_time=never, pool=pool, progress=silent
        )


def with_noise(data: Dataset, folder: Path) -> Dataset:
    """The dataset with images of one camera that show noise."""
    rng = np.random.default_rng(0)
    frames = []
    for frame in data.frames:
        path = folder / f"{frame.name}.png"
        cv2.imwrite(str(path), rng.integers(0, 255, (360, 640, 3), dtype=np.uint8))
        frames.append(replace(frame, image_paths={**frame.image_paths, "left": path}))
    return replace(data, frames=tuple(frames))


class TestArguments:
    @pytest.mark.parametrize(
        ("ranges", "words"),
        [
            ({"search_deg": None}, "both ranges"),
            ({"search_m": None}, "both ranges"),
            ({"search_deg": 90.0}, "up to 45 deg"),
            ({"search_m": -1.0}, "found 20 deg and -1 m"),
            ({"search_m": float("nan")}, "found 20 deg and nan m"),
        ],
    )
    def test_ranges_are_checked(self, ranges: dict[str, float | None], words: str) -> None:
        with pytest.raises(ValueError, match=words):
            StructureMatcher(**ranges)  # type: ignore[arg-type]

    def test_some_frame_is_heeded(self) -> None:
        with pytest.raises(ValueError, match="at least one frame"):
            StructureMatcher(most_frames=0)

    def test_a_time_limit_is_positive(self) -> None:
        with pytest.raises(ValueError, match="the time limit must be positive, found 0"):
            calibgraph.calibrate(SAMPLE, time_limit_s=0)

    @pytest.mark.parametrize(
        ("arguments", "line"),
        [
            (("--search-deg", "far"), "--search-deg far: give a number, or none"),
            (("--search-deg", "100"), "the search reaches up to 45 deg and 5 m per axis"),
            (("--matcher", "m.csv", "--search-m", "1"), "--search-m is for --matcher structure"),
            (("--time-limit-s", "-1"), "--time-limit-s"),
        ],
    )
    def test_one_line_on_the_command_line(
        self, call: Call, tmp_path: Path, arguments: tuple[str, ...], line: str
    ) -> None:
        code, _, err = call("calibrate", SAMPLE, "--out", tmp_path / "out", *arguments)
        assert code == 2
        assert line in err and len(err.strip().splitlines()) == 1

    def test_none_is_no_search(self, call: Call, tmp_path: Path) -> None:
        out = tmp_path / "matches.parquet"
        arguments = ("--frames", "0", "--search-deg", "none", "--time-limit-s", "0.001")
        code, _, err = call("match", SAMPLE, "--out", out, *arguments)
        assert code == 0, err
        metadata = calibgraph.load_correspondences(out).metadata
        assert metadata["range_rotation_deg"] == pytest.approx(2.5)

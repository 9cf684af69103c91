"""The matcher `structure`: its parts on worked cases. The whole, on the sample: test_readme.py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import (
    Camera,
    CorrespondenceError,
    Dataset,
    Intrinsics,
    Rig,
    StructureMatcher,
)
from calibgraph.files import sha256
from calibgraph.matching.structure.consensus import find_consensus, summed_score
from calibgraph.matching.structure.frame_cache import Decoded
from calibgraph.matching.structure.peaks import local_peaks
from calibgraph.matching.structure.schedule import LEVELS, Level
from calibgraph.matching.structure.shift_scores import Scores
from calibgraph.matching.structure.windows import (
    Cloud,
    build_windows,
    thin,
    unoccluded,
    view_angles,
)
from calibgraph.rounds import match_in_rounds
from calibgraph.trust.rematch_checks import check_repeated_clouds
from tests.conftest import KANNALA, SAMPLE, make_camera


def local(levels: Sequence[Level]) -> StructureMatcher:
    """The matcher without its search."""
    return StructureMatcher(search_deg=None, search_m=None, levels=levels)


@pytest.fixture(scope="module")
def truth() -> Rig:
    return calibgraph.load_rig(SAMPLE / "reference.yaml")


def blobs(centres: np.ndarray, reach: int = 12, width: float = 2.0) -> np.ndarray:
    """Score grids with one peak each at the shifts (u, v)."""
    axis = np.arange(-reach, reach + 1)
    u, v = np.meshgrid(axis, axis)
    squares = (u - centres[:, 0, None, None]) ** 2 + (v - centres[:, 1, None, None]) ** 2
    grids = np.exp(-0.5 * squares / width**2)
    return (grids - grids.mean(axis=(1, 2), keepdims=True)).astype(np.float32)


def fake_scores(twist: np.ndarray, *, outliers: float, seed: int = 0) -> Scores:
    """Groups whose peaks a twist explains, but for a share that peak anywhere."""
    rng = np.random.default_rng(seed)
    flow = rng.uniform(-1, 1, (300, 2, 6)) * [200, 200, 200, 40, 40, 40]
    shifts = flow @ twist
    wrong = rng.random(300) < outliers
    shifts[wrong] = rng.uniform(-12, 12, (np.count_nonzero(wrong), 2))
    zeros = np.zeros((300, 3))
    return Scores(
        grids=blobs(shifts),
        flow=flow,
        points_lidar_m=zeros,
        pixels_px=zeros[:, :2],
        frame=np.zeros(300, np.int64),
        counts=np.full(300, 10),
        steps_per_px=np.ones(2),
    )


def test_consensus_finds_the_twist_among_wrong_peaks() -> None:
    twist = np.array([0.01, -0.015, 0.008, 0.05, -0.08, 0.06])
    scores = fake_scores(twist, outliers=0.5)
    found, contrast = find_consensus(scores, LEVELS[0], seed=0)
    off = np.abs(scores.flow @ (found - twist)).max()
    assert off < 1.0  # grid step: the peaks of the groups do the rest
    assert contrast > 15


def test_consensus_of_nothing_does_not_stand_out() -> None:
    scores = fake_scores(np.zeros(6), outliers=1.0)
    _, contrast = find_consensus(scores, LEVELS[0], seed=0)
    assert contrast < 8


def test_summed_score_interpolates() -> None:
    scores = fake_scores(np.zeros(6), outliers=0.0)
    scores = replace(scores, flow=np.tile(np.eye(2, 6), (300, 1, 1)))
    here, between, there = summed_score(scores, np.eye(6)[[0, 0, 0]] * [[0.0], [0.5], [1.0]])
    assert between == pytest.approx((here + there) / 2)


def test_peaks_are_found_to_a_fraction_of_a_step() -> None:
    rng = np.random.default_rng(1)
    true = rng.uniform(-6, 6, (50, 2))
    shift, hessian, peak = local_peaks(blobs(true), true + rng.uniform(-1, 1, (50, 2)))
    assert np.isfinite(peak).all()
    np.testing.assert_allclose(shift, true, atol=0.1)
    # The curvature of a Gaussian of width 2 at its top, by least squares over +-1 step.
    np.testing.assert_allclose(hessian[:, 0, 0], 0.25, rtol=0.25)
    np.testing.assert_allclose(hessian[:, 0, 1], 0.0, atol=0.02)


def test_an_edge_constrains_only_its_normal() -> None:
    axis = np.arange(-12, 13)
    u, v = np.meshgrid(axis, axis)
    along = np.exp(-0.5 * (0.6 * u + 0.8 * v - 1.0) ** 2 / 4).astype(np.float32)
    shift, hessian, _ = local_peaks(along[None], np.zeros((1, 2)))
    values, vectors = np.linalg.eigh(hessian[0])
    assert values[0] == pytest.approx(0.0, abs=1e-9)
    assert abs(vectors[:, 1] @ [0.6, 0.8]) == pytest.approx(1.0, abs=1e-3)
    assert shift[0] @ [0.6, 0.8] == pytest.approx(1.0, abs=0.1)


def test_peaks_at_the_rim_are_dropped() -> None:
    _, _, peak = local_peaks(blobs(np.array([[11.0, 0.0]])), np.array([[11.0, 0.0]]))
    assert peak[0] == -np.inf


def test_background_behind_a_near_object_is_hidden() -> None:
    wall = np.column_stack(
        [*(a.ravel() for a in np.mgrid[-2:2:0.05, -2:2:0.05]), np.full(6400, 20.0)]
    )
    post = np.column_stack([np.zeros(100), np.linspace(-0.4, 0.4, 100), np.full(100, 4.0)])
    points = np.vstack([wall, post])
    clear = unoccluded(view_angles(points), np.linalg.norm(points, axis=1), np.radians(0.5))
    assert clear[-100:].all()
    behind = (np.abs(wall[:, 0]) < 0.04) & (np.abs(wall[:, 1]) < 1.5)
    assert not clear[:-100][behind].any()
    assert clear[:-100][np.abs(wall[:, 0]) > 0.5].all()


def test_thinning_does_not_depend_on_the_order_of_points() -> None:
    rng = np.random.default_rng(0)
    angles = rng.uniform(-0.5, 0.5, (10_000, 2))
    order = rng.permutation(10_000)
    one, two = thin(angles, 0.05), thin(angles[order], 0.05)
    assert len(one) == 400
    np.testing.assert_array_equal(angles[one], angles[order][two])


def test_windows_come_from_clouds_with_and_without_intensity() -> None:
    data = calibgraph.load_dataset(SAMPLE, calibgraph.load_rig(SAMPLE / "reference.yaml"))
    raw = data.frames[0].load_cloud()
    camera = data.rig.cameras["front_left"]
    windows = build_windows(Cloud.of(raw), camera, LEVELS[3], most=10_000)
    raw[:, 3] = np.nan
    blind = build_windows(Cloud.of(raw), camera, LEVELS[3], most=10_000)
    assert len(windows.counts) > len(blind.counts) > 100
    assert not blind.basis[:, :, 1].any()  # nothing from an intensity that is not there
    # Columns are orthogonal to constants and to each other.
    for w in range(50):
        basis = windows.basis[w, : windows.counts[w]].astype(float)
        np.testing.assert_allclose(basis.sum(axis=0), 0, atol=1e-4)
        gram = basis.T @ basis
        np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0, atol=1e-4)


def shuffled(data: Dataset, folder: Path) -> Dataset:
    """The dataset with the points of every cloud in another order."""
    rng = np.random.default_rng(0)
    frames = []
    for frame in data.frames:
        cloud = np.load(frame.cloud_path)
        path = folder / frame.cloud_path.name
        np.save(path, cloud[rng.permutation(len(cloud))])
        frames.append(replace(frame, cloud_path=path))
    return replace(data, frames=tuple(frames))


def test_the_order_of_the_points_does_not_matter(tmp_path: Path) -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:2")
    quick = LEVELS[:2]
    given, other = (
        match_in_rounds(d, matcher=local(quick), progress=lambda *_: None)
        for d in (data, shuffled(data, tmp_path))
    )
    errors = calibgraph.evaluate(given.solution.solved_rig, other.solution.solved_rig)
    for error in errors.cameras.values():
        assert error.rotation_error_deg < 0.02
        assert error.translation_error_cm < 0.5


def test_a_frame_given_twice_is_pointed_out() -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:2")
    copy = replace(data.frames[0], index=2, name="copy")
    data = replace(data, frames=(*data.frames, copy))
    hashes = {str(frame.cloud_path): sha256(frame.cloud_path) for frame in data.frames}
    (check,) = check_repeated_clouds(data, hashes)
    assert check.status == "WARN" and "000000 and copy have the same cloud" in check.text
    assert check_repeated_clouds(replace(data, frames=data.frames[:2]), hashes) == []


def repeated(data: Dataset, count: int) -> Dataset:
    """So many frames, again and again the same: of the dataset, and recorded as one drive."""
    given = data.frames
    frames = tuple(replace(given[i % len(given)], index=i, name=str(i)) for i in range(count))
    return replace(data, frames=frames)


def test_more_frames_do_not_give_fewer_matches(truth: Rig) -> None:
    """Frames share the windows that bound the time, and a group needs some in one frame."""
    rig = Rig(cameras={"left": truth.cameras["left"]})
    data = calibgraph.load_dataset(SAMPLE, rig)
    matcher = StructureMatcher()
    matches = [
        len(matcher.match(repeated(data, count), rig, round_index=5, progress=lambda *_: None))
        for count in (6, 60)
    ]
    assert matches[1] > matches[0]


def test_small_lenses_give_matches_too(tmp_path: Path, truth: Rig) -> None:
    """Images of 320 pixels: the last rounds reach some pixels only, by their angles."""
    camera = truth.cameras["left"]
    k = camera.intrinsics_px
    half = {"fx": k.fx / 2, "fy": k.fy / 2, "cx": (k.cx + 0.5) / 2 - 0.5}
    smaller = {
        "width_px": camera.width_px // 2,
        "height_px": camera.height_px // 2,
        "intrinsics_px": Intrinsics(**half, cy=(k.cy + 0.5) / 2 - 0.5),
    }
    small = Camera(**{**camera.model_dump(), **smaller})
    rig = Rig(cameras={"left": small})
    frames = []
    for frame in calibgraph.load_dataset(SAMPLE).frames:
        image = cv2.imread(str(frame.image_paths["left"]))
        path = tmp_path / f"{frame.name}.png"
        size = (small.width_px, small.height_px)
        cv2.imwrite(str(path), cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        frames.append(replace(frame, image_paths={"left": path}))
    data = Dataset(rig, tuple(frames), (tmp_path,))
    guess = calibgraph.perturb(rig, rotation_deg=0.5, translation_m=0.05, seed=0)
    found = match_in_rounds(data, guess, local(LEVELS[3:]), progress=lambda *_: None)
    error = calibgraph.evaluate(found.solution.solved_rig, rig).cameras["left"]
    pixel_deg = np.degrees(1 / small.intrinsics_px.fx)
    assert error.rotation_error_deg < pixel_deg
    assert error.translation_error_cm < 10


def test_a_long_drive_is_thinned_unless_it_is_asked_for(truth: Rig) -> None:
    drive = repeated(calibgraph.load_dataset(SAMPLE, truth), 100)
    seen = []

    class Counting(StructureMatcher):
        def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN202
            seen.append([frame.index for frame in dataset.frames])
            return calibgraph.simulate_correspondences(rig, matches=100)

    local_only = {"search_deg": None, "search_m": None, "levels": LEVELS[:1]}
    for most in (None, 30):
        settings = local_only if most else {**local_only, "most_frames": None}
        match_in_rounds(drive, matcher=Counting(**settings), progress=lambda *_: None)  # type: ignore[arg-type]
    assert seen[0] == list(range(100))
    assert len(seen[-1]) == 30 and seen[-1][0] == 0 and seen[-1][-1] == 99
    assert set(np.diff(seen[-1])) == {3, 4}


def test_what_is_decoded_is_of_the_frames_at_hand_as_they_are_now(tmp_path: Path) -> None:
    data = calibgraph.load_dataset(SAMPLE)
    camera = data.rig.cameras["left"]
    path = tmp_path / "image.png"
    cv2.imwrite(str(path), np.full((camera.height_px, camera.width_px), 100, np.uint8))
    frame = replace(data.frames[0], image_paths={"left": path})
    decoded = Decoded()
    assert decoded.image(frame, "left", camera).mean() == 100
    cv2.imwrite(str(path), np.zeros((camera.height_px, camera.width_px), np.uint8))
    assert decoded.image(frame, "left", camera).mean() == 0
    cloud = decoded.cloud(frame)
    decoded.keep_only([frame])
    assert decoded.cloud(frame) is cloud
    decoded.keep_only(data.frames[1:])
    assert decoded.cloud(frame) is not cloud


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers() -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:2")
    one, two = (calibgraph.calibrate(data, matcher=local(LEVELS[:1])) for _ in range(2))
    for name, T in one.T_camera_lidar.items():
        np.testing.assert_array_equal(T, two.T_camera_lidar[name])


def test_a_camera_that_sees_none_of_the_cloud_is_named(truth: Rig) -> None:
    T = dict(truth.T_camera_lidar)
    T["left"] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ T["left"]
    data = replace(calibgraph.load_dataset(SAMPLE).select("0"), rig=truth.moved_to(T))
    with pytest.raises(CorrespondenceError, match="camera 'left' has 0 usable"):
        calibgraph.calibrate(data, matcher=local(LEVELS))


def test_fisheyes_and_views_past_90_degrees_give_windows() -> None:
    raw = calibgraph.load_dataset(SAMPLE).frames[0].load_cloud()
    camera = Camera(
        model="fisheye",
        width_px=2600,
        height_px=2600,
        intrinsics_px=Intrinsics(fx=700.0, fy=700.0, cx=1300.0, cy=1300.0),
        distortion=KANNALA,
        T_camera_lidar=make_camera().T_camera_lidar,
    )
    windows = build_windows(Cloud.of(raw), camera, LEVELS[2], most=10_000)
    T = camera.T_camera_lidar
    z = (windows.rays_m.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3])[:, 2]
    assert z.min() < 0 < z.max()
    assert len(windows.counts) > 100

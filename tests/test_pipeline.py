"""The two calls of the library: what is saved, solved again, is what was reported."""

import pickle
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

import calibgraph
from calibgraph import (
    Calibration,
    Config,
    Correspondences,
    FileError,
    MatcherErrors,
    Rig,
    perturb,
    simulate_correspondences,
)
from calibgraph.graph.variables import MOST_CAMERAS, aligned_key, camera_key
from calibgraph.model.config import preset
from calibgraph.model.geometry import invert, twist_between
from calibgraph.model.places import Places
from tests.conftest import SAMPLE, Call, stereo_relative_pose
from tests.draws.lenses import with_known_lenses
from tests.matching.structure.data import with_noise_images
from tests.solver.test_places import minimize

pytestmark = pytest.mark.usefixtures("no_image_checks")

FRAMES = 6
STATED = {
    "systematic_rotation_rad": 1e-3, "systematic_translation_m": 0.01,
    "elevation_rad": 5e-4, "place_rotation_rad": 7e-4, "place_translation_m": 0.006,
    "place_variance": 8.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def guess(truth: Rig) -> Rig:
    return perturb(truth, rotation_deg=1, translation_m=0.1, seed=3)


def table_of(rig: Rig) -> Correspondences:
    """With an error that its frames share, found where places can be found."""
    errors = MatcherErrors(outlier_share=0.1, frame_noise_px=0.5)
    table = simulate_correspondences(rig, frames=FRAMES, matches=100, errors=errors)
    stated = STATED | {"z_score": dict.fromkeys(rig.cameras, 30.0)}
    return replace(table, metadata={**table.metadata, **stated})


def solve_again(saved: Calibration) -> Calibration:
    """The saved table, from the saved result, with its settings."""
    return calibgraph.solve(
        saved.rig,
        saved.correspondences,
        saved.config,
        saved.terms,
        camera_matches=saved.camera_matches,
    )


def require_same(saved: Calibration, again: Calibration) -> None:
    """Within 1e-3 sigma: the tolerance at which the fit of the error model stops."""
    for name in saved.rig.cameras:
        covariance, other = saved.covariance[name], again.covariance[name]
        xi = twist_between(saved.T_camera_lidar[name], again.T_camera_lidar[name])
        if covariance is None or other is None:
            assert covariance is None and other is None
            np.testing.assert_allclose(xi, 0.0, atol=1e-9)
            continue
        sigma = np.sqrt(np.diag(covariance))
        assert np.abs(xi / sigma).max() < 1e-3, name
        scaled = (other - covariance) / np.outer(sigma, sigma)
        assert np.abs(scaled).max() < 1e-3, name
        mine, other_verdict = saved.camera_verdicts[name], again.camera_verdicts[name]
        assert mine.status == other_verdict.status
        kinds = [[(c.kind, c.status) for c in v.checks] for v in (mine, other_verdict)]
        assert kinds[0] == kinds[1]
    assert again.counts == saved.counts


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The sample's frames as two recordings, the second mirrored: another place."""
    made = []
    for part, stems in enumerate((("000000", "000001", "000002"), ("000003", "000004", "000005"))):
        folder = tmp_path_factory.mktemp(f"part{part}")
        (folder / "lidar").mkdir()
        for stem in stems:
            cloud = np.load(SAMPLE / "lidar" / f"{stem}.npy")
            np.save(folder / "lidar" / f"{stem}.npy", cloud * [1, 1 - 2 * part, 1, 1])
            for images in (SAMPLE / "cameras").iterdir():
                (image,) = images.glob(f"{stem}.*")
                (folder / "cameras" / images.name).mkdir(parents=True, exist_ok=True)
                shutil.copy(image, folder / "cameras" / images.name)
        made.append(folder)
    return made


def calibrated(
    case: str, guess: Rig, truth: Rig, recordings: Sequence[Path], folder: Path
) -> Calibration:
    names = {"one camera": ["front_left"], "no overlap": ["front_left", "left"]}.get(case)
    guess, truth = (
        Rig(cameras={name: rig.cameras[name] for name in names or rig.cameras})
        for rig in (guess, truth)
    )
    if case == "relative pose":
        known = stereo_relative_pose(truth, "front_left", "left")
        guess = guess.model_copy(update={"relative_poses": (known,)})
    data, table = calibgraph.load_dataset(recordings, guess), table_of(truth)
    if case == "excluded camera":  # its images show noise, and few of its correspondences agree
        own = np.flatnonzero(table.camera_index == table.cameras.index("left"))
        pixels = table.pixels_px.copy()
        pixels[own] = pixels[np.roll(own, 37)]
        data = with_noise_images(data, "left", folder)
        kept = np.setdiff1d(np.arange(len(table)), own[7:])
        table = replace(table, pixels_px=pixels).select(kept)
    time_limit_s = 1e-9 if case == "no time" else None
    return calibgraph.calibrate(data, guess, table, time_limit_s=time_limit_s)


@pytest.mark.parametrize(
    "case",
    [
        "excluded camera",
        *(
            pytest.param(each, marks=pytest.mark.slow)
            for each in ("one camera", "no overlap", "overlap", "relative pose", "no time")
        ),
    ],
)
def test_the_saved_table_solved_again_gives_the_saved_result(
    case: str, guess: Rig, truth: Rig, recordings: Sequence[Path], tmp_path: Path
) -> None:
    made = calibrated(case, guess, truth, recordings, tmp_path)
    made.save(tmp_path / "result")
    saved = calibgraph.load_calibration(tmp_path / "result")
    require_same(saved, made)
    require_same(saved, solve_again(saved))
    assert saved.counts["front_left"]["places"] > 1
    for name, sigmas in ((n, saved.sigmas(n)) for n in saved.rig.cameras):
        assert (sigmas is None) == (case == "excluded camera" and name == "left")


def test_a_rig_is_taken_by_its_path_and_settings_as_a_mapping(guess, truth, tmp_path):
    guess.save(tmp_path / "rig.yaml")
    table, rig = table_of(truth), str(tmp_path / "rig.yaml")
    one = calibgraph.solve(guess, table, preset("kitti"))
    two = calibgraph.solve(rig, table, {"preset": "kitti"})
    np.testing.assert_array_equal(one.T_camera_lidar["left"], two.T_camera_lidar["left"])
    assert one.config == two.config
    with pytest.raises(FileError, match="tau"):
        calibgraph.solve(rig, table, {"tau": 1})
    with pytest.raises(FileError, match="tau"):
        calibgraph.calibrate(tmp_path, rig, config={"tau": 1})


def test_places_of_the_table_count_in_the_solve(guess: Rig, truth: Rig) -> None:
    """The same table with two places named: a narrower error bar, so the test above can fail."""
    table = table_of(truth)
    named = table.with_places(Places(places=((0, 1, 2), (3, 4, 5))))
    one, two = (calibgraph.solve(guess, each) for each in (table, named))
    for name in truth.cameras:
        a, b = one.covariance[name], two.covariance[name]
        assert np.trace(b[:3, :3]) < 0.9 * np.trace(a[:3, :3])


@pytest.mark.ci
@pytest.mark.slow
def test_the_commands_solve_what_calibrate_saved(
    guess: Rig, truth: Rig, recordings: Sequence[Path], tmp_path: Path, call: Call
) -> None:
    made = calibrated("overlap", guess, truth, recordings, tmp_path)
    made.save(tmp_path / "result")
    given = (tmp_path / "result", tmp_path / "result" / "correspondences.parquet")
    matches = ("--camera-matches", tmp_path / "result" / "camera_matches.parquet")
    code, _, err = call("solve", *given, *matches, "--out", tmp_path / "again")
    assert code == 0, err
    require_same(made, calibgraph.load_calibration(tmp_path / "again"))


def test_an_excluded_camera_is_told_so_and_its_images_are_not_blamed(
    guess: Rig, truth: Rig
) -> None:
    result = calibgraph.solve(guess, table_of(truth), Config(excluded_cameras=("left",)))
    (check,) = (c for c in result.camera_verdicts["left"].checks if c.name == "correspondences")
    assert check.text.startswith("excluded by the settings") and "sharp" not in check.text
    assert not any("sharp" in action for action in result.summary.actions)


def test_an_excluded_camera_that_the_rig_lacks_is_refused(guess: Rig, truth: Rig) -> None:
    with pytest.raises(ValueError, match=r"excluded_cameras names 'rear'; the rig has front_left"):
        calibgraph.solve(guess, table_of(truth), Config(excluded_cameras=("rear",)))


@pytest.mark.parametrize("config", [Config(), preset("kitti")], ids=["auto", "kitti"])
def test_the_result_is_the_optimum_of_its_graph(truth: Rig, guess: Rig, config: Config) -> None:
    """GTSAM's Levenberg-Marquardt, from where all poses of a camera are equal."""
    table = table_of(truth).with_places(Places(places=((0, 1, 2), (3, 4, 5))))
    known = with_known_lenses(guess.moved_to(truth.T_camera_lidar))
    result = calibgraph.solve(known, table, config)
    values = minimize(result.graph, values_of(result))
    covariance = result.joint_covariance
    of = aligned_key if config.preset == "auto" else camera_key
    keys = [*map(of, range(len(truth.cameras)))]
    for number, (name, T) in enumerate(result.T_camera_lidar.items()):
        found = invert(values.atPose3(keys[number]).matrix())
        sigmas = np.sqrt(np.diag(covariance))[6 * number : 6 * number + 6]
        assert np.abs(twist_between(found, T) / sigmas).max() < 0.01, name
    if config.preset == "auto":
        marginals = gtsam.Marginals(result.graph, values)
        expected = marginals.jointMarginalCovariance(keys).fullMatrix()
        np.testing.assert_allclose(np.diag(covariance), np.diag(expected), rtol=0.01)


def values_of(result: Calibration) -> gtsam.Values:
    """All poses of a camera at the result, the cloud where it is, no distortion."""
    poses = [invert(T) for T in result.T_camera_lidar.values()]
    values = gtsam.Values()
    for key in result.graph.keyVector():
        letter, index = chr(gtsam.symbolChr(key)), gtsam.symbolIndex(key)
        if letter == "d":
            values.insert(key, np.zeros(3))
        elif letter in "op":
            values.insert(key, gtsam.Pose3())
        else:
            values.insert(key, gtsam.Pose3(poses[index % MOST_CAMERAS]))
    return values


def test_the_graph_is_printed(truth: Rig, call: Call, tmp_path: Path) -> None:
    table_of(truth).save(tmp_path / "table.parquet")
    truth.save(tmp_path / "rig.yaml")
    inputs = tmp_path / "rig.yaml", tmp_path / "table.parquet", "--out", tmp_path / "out"
    code, out, _ = call("solve", *inputs, "--print-graph")
    assert code == 0
    assert "PriorFactor on o0" in out and "BetweenFactor(o0,p0)" in out
    code, _, error = call("solve", *inputs, "--print-graph", "--json")
    assert code == 2 and "choose one" in error


def test_a_result_from_a_file_has_no_graph(truth: Rig, tmp_path: Path) -> None:
    result = calibgraph.solve(truth, table_of(truth))
    result.save(tmp_path)
    for other in (calibgraph.load_calibration(tmp_path), pickle.loads(pickle.dumps(result))):
        with pytest.raises(ValueError, match="another process has no graph; solve a table"):
            _ = other.graph

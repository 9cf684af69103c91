"""Training: samples whose flow is true, runs that can be stopped and resumed, honest validation."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from calibgraph import CalibrationError, DatasetError, FileError, load_rig
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.cmrnext import TrainSettings, load_checkpoint, train
from calibgraph.matching.cmrnext.architecture import Architecture
from calibgraph.matching.cmrnext.inputs import View
from calibgraph.matching.cmrnext.training.samples import Scene, _mirror, _turn, make_sample, draw_perturbation
from calibgraph.matching.cmrnext.training.scenes import split, load_trusted_dataset
from calibgraph.matching.cmrnext.training.settings import parsed_crop
from calibgraph.matching.cmrnext.training.train import one_cycle
from calibgraph.matching.cmrnext.training.validation import MAX_SCENES
from tests.conftest import SAMPLE, Call
from tests.matching.cmrnext.test_checkpoint import good_content, saved

TINY = TrainSettings(
    rotation_deg=1.0,
    translation_m=0.1,
    steps=4,
    batch=1,
    iterations=2,
    crop_px=(128, 192),
    width=8,
    correlation_weight=0.1,
    correlation_steps=1,
)


@pytest.fixture(scope="module")
def trusted() -> Dataset:
    return load_trusted_dataset(SAMPLE)


@pytest.fixture(scope="module")
def parts(trusted: Dataset) -> tuple[Dataset, Dataset]:
    return trusted.select("0:2"), trusted.select("5")


def scene(dataset: Dataset, name: str = "front_left") -> Scene:
    return Scene(dataset.frames[0], name, dataset.rig.cameras[name])


def test_the_reference_is_trusted_and_not_the_guess(trusted: Dataset, tmp_path: Path) -> None:
    truth = load_rig(SAMPLE / "reference.yaml").T_camera_lidar
    for name, T in trusted.rig.T_camera_lidar.items():
        np.testing.assert_array_equal(T, truth[name])
    folder = tmp_path / "data"
    shutil.copytree(SAMPLE, folder)
    (folder / "reference.yaml").unlink()
    with pytest.raises(DatasetError, match="rig.yaml is a guess"):
        load_trusted_dataset(folder)
    assert load_trusted_dataset(folder, trusted.rig).rig == trusted.rig


def test_perturbations_are_those_of_the_published_protocol() -> None:
    """Median angle about 19.6 deg and length 1.42 to 1.45 m, as the original's logs say."""
    rng = np.random.default_rng(0)
    draws = np.array([draw_perturbation(rng, 20.0, 1.5) for _ in range(4000)])
    angles = np.degrees(Rotation.from_matrix(draws[:, :3, :3]).magnitude())
    lengths = np.linalg.norm(draws[:, :3, 3], axis=1)
    # Medians of 4000: sigma about 1.25 spread / sqrt(4000), so 0.13 deg and 0.008 m.
    assert np.median(angles) == pytest.approx(19.6, abs=0.5)
    assert np.median(lengths) == pytest.approx(1.43, abs=0.04)
    assert draws[:, 1, 3].max() <= 1.0 and draws[:, 0, 3].max() > 1.4


@pytest.mark.parametrize("change", [_mirror, _turn])
def test_augmented_clouds_still_fit_their_images(trusted: Dataset, change: object) -> None:
    """Points keep the colour of the pixel that they lie on."""
    some = scene(trusted)
    view = View(some.camera)
    image = view.undistort(some.frame.load_image(some.name, some.camera))
    cloud = some.frame.load_cloud().astype(np.float64)
    T = some.camera.T_camera_lidar
    cloud[:, :3] = cloud[:, :3] @ T[:3, :3].T + T[:3, 3]
    rng = np.random.default_rng(1)  # its first draw mirrors
    changed_image, changed = change(image, cloud, view, rng)  # type: ignore[operator]
    assert not np.array_equal(changed_image, image)

    def colours(picture: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = view.project(points[:, :3])
        size = [view.width - 1, view.height - 1]
        inside = (points[:, 2] > 1) & ((pixels > 0) & (pixels < size)).all(axis=1)
        x, y = np.where(inside[:, None], pixels, 0).round().astype(int).T
        return picture[y, x].astype(float), inside

    before, seen_before = colours(image, cloud)
    after, seen_after = colours(changed_image, changed)
    both = seen_before & seen_after
    assert np.count_nonzero(both) > 1000
    difference = np.abs(before - after)[both].max(axis=1)
    shuffled = np.abs(before[both] - np.roll(after[both], 500, axis=0)).max(axis=1)
    # Interpolation blurs the texture: half of the points within 8 of 255, and by chance few.
    assert np.median(difference) < 8 < 0.5 * np.median(shuffled)


def test_the_flow_of_a_sample_leads_to_the_true_pixel(trusted: Dataset) -> None:
    some = scene(trusted)
    settings = replace(TINY.samples(augment=False), half_resolution=True)
    sample = make_sample(
        some, settings=settings, architecture=TINY.architecture, rng=np.random.default_rng(0)
    )
    assert sample is not None
    view = View(some.camera)
    expected = view.project(sample.points_camera_m)
    np.testing.assert_allclose(sample.pixels_px + sample.flow_px.numpy(), expected, atol=1e-3)
    perturbed = sample.points_camera_m @ np.linalg.inv(sample.E)[:3, :3].T
    start = view.project(perturbed + np.linalg.inv(sample.E)[:3, 3])
    np.testing.assert_allclose(sample.pixels_px, start, atol=1e-3)
    assert np.array_equal(sample.cells.numpy(), np.floor(sample.pixels_px[:, ::-1]))
    assert sample.rgb.shape[1:] == sample.lidar.shape[1:]


@pytest.mark.slow
def test_a_stopped_training_goes_on_as_if_it_had_not_been(
    parts: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    one, other = tmp_path / "one.tar", tmp_path / "other.tar"
    whole = train([parts[0]], [parts[1]], one, TINY, validate_every=2)

    def stop(what: str, done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train([parts[0]], [parts[1]], other, TINY, validate_every=2, progress=stop)
    rest = train([parts[0]], [parts[1]], other, validate_every=2, resume=True)
    assert [v.step for v in whole] == [2, 4] and [v.step for v in rest] == [4]
    assert rest[0].epe_px == pytest.approx(whole[1].epe_px, rel=1e-5)
    states = [load_checkpoint(path).state for path in (one, other)]
    for name, tensor in states[0].items():
        torch.testing.assert_close(tensor, states[1][name], msg=name)


def test_the_checkpoint_says_what_it_was_trained_for(
    parts: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    out = tmp_path / "net.tar"
    settings = TINY.changed(steps=1, half_resolution=True, reflectance=True, fourier_levels=4)
    (validation,) = train([parts[0]], [parts[1]], out, settings)
    checkpoint = load_checkpoint(out)
    assert checkpoint.range_deg_m == (1.0, 0.1)
    assert checkpoint.architecture == settings.architecture
    assert checkpoint.config["half_resolution"] is True
    assert checkpoint.config["systematic_rotation_rad"] == validation.systematic_rotation_rad
    assert 0.3 < validation.start_deg < np.sqrt(3)
    assert 1.0 < validation.zero_px < 30.0  # 1 deg is 10 px
    assert not list(tmp_path.glob(".writing-*"))


def test_fine_tuning_starts_from_given_weights(
    parts: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    first, second = tmp_path / "first.tar", tmp_path / "second.tar"
    train([parts[0]], [parts[1]], first, TINY.changed(steps=1, fourier_levels=3))
    gentle = TINY.changed(steps=1, learning_rate=1e-12)
    train([parts[0]], [parts[1]], second, gentle, start=first)
    before, after = load_checkpoint(first), load_checkpoint(second)
    assert after.architecture == before.architecture
    weights = [name for name in before.state if name.endswith("weight")]
    for name in weights:  # with no learning rate to speak of, they are the same
        torch.testing.assert_close(after.state[name], before.state[name], atol=1e-6, rtol=0)
    sigmas = saved(tmp_path / "nll.tar", nll_content())
    with pytest.raises(FileError, match="uncertainty head"):
        train([parts[0]], [parts[1]], tmp_path / "third.tar", TINY, start=sigmas)


def nll_content() -> dict[str, object]:
    content = good_content(Architecture(width=8, uncertainty="nll"))
    content["config"]["uncertainty"] = True
    return content


@pytest.mark.slow
def test_encoders_learn_to_find_each_other(trusted: Dataset, tmp_path: Path) -> None:
    """On one picture, over and over: the correlation loss falls below ignorance, ln 49."""
    settings = TINY.changed(
        steps=60, correlation_steps=60, correlation_weight=1.0, learning_rate=5e-3,
        warm_up_share=0.1, crop_px=None, half_resolution=True, width=16, fourier_levels=4,
    )  # fmt: skip
    one = replace(trusted.select("0"), rig=trusted.rig)
    losses = [
        v.train_loss
        for v in train([one], [trusted.select("1")], tmp_path / "n.tar", settings,
                       validate_every=30)
    ]  # fmt: skip
    assert losses[1] < losses[0]
    assert losses[1] < np.log(49)


def test_misuse_is_refused(parts: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    out = tmp_path / "net.tar"
    with pytest.raises(DatasetError, match="hold out others"):
        train([parts[0]], [parts[0]], out, TINY)
    with pytest.raises(FileError, match="no such checkpoint"):
        train([parts[0]], [parts[1]], out, resume=True)
    with pytest.raises(FileError, match="must end in"):
        train([parts[0]], [parts[1]], tmp_path / "net.safetensors", TINY)
    out.write_bytes(b"precious")
    with pytest.raises(FileError, match="is a file, expected a folder"):
        train([parts[0]], [parts[1]], out / "net.tar", TINY)
    with pytest.raises(FileError, match="is there already"):
        train([parts[0]], [parts[1]], out, TINY)
    assert out.read_bytes() == b"precious"


@pytest.mark.parametrize(
    "wrong",
    [
        {"context": "foo"},
        {"width": 12},
        {"width": 100_000},
        {"rotation_deg": 0.0},
        {"rotation_deg": float("inf")},
        {"learning_rate": float("nan")},
        {"correlation_weight": 0.0, "correlation_steps": 5},
        {"crop_px": (32, 64)},
        {"fourier_levels": 50},
        {"steps": 0},
        {"surplus": 1},
    ],
)
def test_settings_that_cannot_be_trained_are_refused_at_once(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError) as caught:
        TINY.changed(**wrong)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c["config"].update(train_width=16),
        lambda c: c["config"].update(train_context="rgb"),
        lambda c: c["config"].update(train_batch=0),
        lambda c: c["config"].update(train_crop_px=(3, "x")),
        lambda c: c["config"].update(train_steps="x"),
        lambda c: c.update(epoch=float("inf")),
        lambda c: c.update(epoch=-5),
        lambda c: c.update(optimizer=5),
        lambda c: c["optimizer"].update(state=5),
        lambda c: c["optimizer"]["state"][0].update(exp_avg=torch.zeros(1)),
        lambda c: c["optimizer"]["state"][0]["exp_avg"].fill_(torch.nan),
        lambda c: [c["config"].pop(key) for key in list(c["config"]) if "train_" in key],
    ],
)
def test_resuming_from_a_changed_file_is_refused(
    once: Path, parts: tuple[Dataset, Dataset], tmp_path: Path, change: object
) -> None:
    content = torch.load(once, weights_only=True)
    change(content)  # type: ignore[operator]
    path = saved(tmp_path / "changed.tar", content)
    before = path.read_bytes()
    with pytest.raises(FileError, match="changed.tar") as caught:
        train([parts[0]], [parts[1]], path, resume=True)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 2500
    assert path.read_bytes() == before


@pytest.fixture(scope="module")
def once(parts: tuple[Dataset, Dataset], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of 3 steps, stopped after the first."""
    path = tmp_path_factory.mktemp("once") / "net.tar"

    def stop(what: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train([parts[0]], [parts[1]], path, TINY.changed(steps=3), validate_every=1, progress=stop)
    return path


def test_a_training_that_diverges_says_so(
    once: Path, parts: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    content = torch.load(once, weights_only=True)
    content["state_dict"]["update_block.flow_head.conv2.weight"].fill_(3e38)
    path = saved(tmp_path / "net.tar", content)
    before = path.read_bytes()
    with pytest.raises(CalibrationError, match="diverged at step 1"):
        train([parts[0]], [parts[1]], path, resume=True)
    assert path.read_bytes() == before


def test_frames_are_split_at_the_end(trusted: Dataset) -> None:
    (first,), (last,) = split([trusted])
    assert [f.index for f in first.frames] == [0, 1, 2, 3, 4]
    assert [f.index for f in last.frames] == [5]
    with pytest.raises(DatasetError, match="--held-out"):
        split([trusted.select("0")])


def test_validation_keeps_few_of_many_scenes(trusted: Dataset) -> None:
    many = [scene(trusted)] * 250 + [scene(trusted, "left")] * 250
    kept = spread_out(many, MAX_SCENES)
    assert len(kept) == MAX_SCENES
    assert sum(s.name == "left" for s in kept) == MAX_SCENES // 2
    assert spread_out(many[:3], MAX_SCENES) == many[:3]


def test_crops_are_read() -> None:
    assert parsed_crop("320x961") == (320, 960)
    assert parsed_crop("none") is None
    for text in ("320", "axb", "10x960", "-320x960"):
        with pytest.raises(ValueError, match="expected HxW"):
            parsed_crop(text)


def test_the_learning_rate_rises_and_falls() -> None:
    assert one_cycle(0.0, 0.4) == pytest.approx(0.1)
    assert one_cycle(0.4, 0.4) == pytest.approx(1.0)
    assert one_cycle(1.0, 0.4) == pytest.approx(1e-6)


def test_training_runs_on_the_command_line(tmp_path: Path, call: Call) -> None:
    out = tmp_path / "net.tar"
    small = ("--width", 8, "--crop-px", "128x192", "--iterations", 1, "--batch", 1)
    given = ("train", SAMPLE, "--out", out, "--steps", 1, *small)
    code, _, text = call(*given)
    assert code == 0
    assert "held out: flow error" in text
    assert call("weights", out)[0] == 0
    code, _, text = call(*given)
    assert code == 2 and "is there already" in text and text.count("\n") == 1
    code, _, text = call(*given, "--resume")
    assert code == 2 and "--steps: --resume goes on with the settings in" in text
    code, _, text = call("train", SAMPLE, "--out", out, "--resume")
    assert code == 2 and "has had all its 1 steps" in text
    code, _, text = call("train", SAMPLE, "--out", tmp_path / "c.tar", "--width", 12)
    assert code == 2 and "width 12" in text and text.count("\n") == 1
    code, _, text = call("train", tmp_path / "nothing", "--out", tmp_path / "b.tar")
    assert code == 2 and text.count("\n") == 1

"""Training: runs can be stopped and resumed, start from given weights, and refuse misuse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from calibgraph import CalibrationError, Dataset, DatasetError, FileError
from calibgraph.files import load_model
from calibgraph.io.dataset import spread_out
from calibgraph.matching.cmrnext import TrainSettings, load_checkpoint, train
from calibgraph.matching.cmrnext.training.run import one_cycle
from calibgraph.matching.cmrnext.training.validation import MAX_SCENES
from tests.matching.cmrnext.builders import nll_content, saved
from tests.matching.cmrnext.training.tiny import TINY, scene


@pytest.mark.slow
def test_a_resumed_training_equals_an_uninterrupted_one(
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


@pytest.mark.slow
def test_the_checkpoint_holds_the_range_of_training(
    parts: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    out = tmp_path / "net.tar"
    settings = TINY.changed(steps=1, half_resolution=True, reflectance=True, fourier_levels=4)
    (validation,) = train([parts[0]], [parts[1]], out, settings)
    checkpoint = load_checkpoint(out)
    assert checkpoint.range_deg_m == (1.0, 0.1)
    assert checkpoint.architecture == settings.architecture
    assert checkpoint.config["half_resolution"] is True
    assert load_model(TrainSettings, tmp_path / "net.settings.yaml") == settings
    assert checkpoint.config["systematic_rotation_rad"] == validation.systematic_rotation_rad
    assert 0.3 < validation.start_deg < np.sqrt(3)
    assert 1.0 < validation.zero_px < 30.0  # 1 deg is 10 px
    assert not list(tmp_path.glob(".writing-*"))


@pytest.mark.slow
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


@pytest.mark.slow
def test_fine_tuning_on_the_pose_changes_the_flow(
    parts: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    flow, pose = tmp_path / "flow.tar", tmp_path / "pose.tar"
    settings = TINY.changed(steps=2, correlation_weight=0.0, correlation_steps=0)
    (of_flow,) = train([parts[0]], [parts[1]], flow, settings)
    (of_pose,) = train([parts[0]], [parts[1]], pose, settings.changed(pose_weight=1.0))
    assert np.isfinite(of_pose.train_loss)
    assert of_pose.train_loss != of_flow.train_loss
    assert load_checkpoint(pose).config["train_pose_weight"] == 1.0
    one, other = (load_checkpoint(path).state for path in (flow, pose))
    assert any(not torch.equal(one[name], other[name]) for name in one)


@pytest.mark.slow
def test_encoders_learn_to_find_each_other(trusted: Dataset, tmp_path: Path) -> None:
    """On one image, repeatedly: the correlation loss falls below that of a uniform guess, ln 49."""
    settings = TINY.changed(
        steps=120, correlation_steps=120, correlation_weight=1.0, learning_rate=5e-3,
        warm_up_share=0.1, crop_px=None, half_resolution=True, width=16, fourier_levels=4,
    )  # fmt: skip
    one = replace(trusted.select("0"), rig=trusted.rig)
    losses = [
        v.train_loss
        for v in train([one], [trusted.select("1")], tmp_path / "n.tar", settings,
                       validate_every=60)
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


CHANGES = (
    lambda c: c["config"].update(train_width=16),
    lambda c: c["config"].update(train_context="rgb"),
    lambda c: c["config"].update(train_batch=0),
    lambda c: c["config"].update(train_crop_px=(3, "x")),
    lambda c: c["config"].update(train_steps="x"),
    lambda c: c.update(epoch=float("inf")),
    lambda c: c.update(epoch=-5),
    lambda c: c.update(optimizer=5),
    lambda c: c["optimizer"].update(state=5),
    lambda c: c["optimizer"]["state"][0].update(exp_avg=5),
    lambda c: c["optimizer"]["state"][0].pop("step"),
    lambda c: c["optimizer"]["state"][0].update(exp_avg=torch.zeros(1)),
    lambda c: c["optimizer"]["state"][0]["exp_avg"].fill_(torch.nan),
    lambda c: [c["config"].pop(key) for key in list(c["config"]) if "train_" in key],
)


def test_resuming_from_a_changed_file_is_refused(
    once: Path, parts: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    path = tmp_path / "changed.tar"
    for number, change in enumerate(CHANGES):
        content = torch.load(once, weights_only=True)
        change(content)  # type: ignore[no-untyped-call]
        before = saved(path, content).read_bytes()
        with pytest.raises(FileError, match="changed.tar") as caught:
            train([parts[0]], [parts[1]], path, resume=True)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 2500, number
        assert path.read_bytes() == before, number


def test_a_training_that_diverges_is_reported(
    once: Path, parts: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    content = torch.load(once, weights_only=True)
    content["state_dict"]["update_block.flow_head.conv2.weight"].fill_(3e38)
    path = saved(tmp_path / "net.tar", content)
    before = path.read_bytes()
    with pytest.raises(CalibrationError, match="diverged at step 1"):
        train([parts[0]], [parts[1]], path, resume=True)
    assert path.read_bytes() == before


def test_validation_keeps_few_of_many_scenes(trusted: Dataset) -> None:
    many = [scene(trusted)] * 250 + [scene(trusted, "left")] * 250
    kept = spread_out(many, MAX_SCENES)
    assert len(kept) == MAX_SCENES
    assert sum(s.name == "left" for s in kept) == MAX_SCENES // 2
    assert spread_out(many[:3], MAX_SCENES) == many[:3]


def test_the_learning_rate_rises_and_falls() -> None:
    assert one_cycle(0.0, 0.4) == pytest.approx(0.1)
    assert one_cycle(0.4, 0.4) == pytest.approx(1.0)
    assert one_cycle(1.0, 0.4) == pytest.approx(1e-6)

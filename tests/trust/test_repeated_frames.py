from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import calibgraph
from calibgraph import CorrespondenceError, Correspondences, Rig, concatenate, solve
from calibgraph.trust.rematch_checks import check_repeated_files
from tests.conftest import SAMPLE
from tests.trust.conftest import simulated


def test_frames_with_the_same_cloud_or_image_are_reported() -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:3")
    hashes = {path: digest for frame in data.frames for path, digest in frame.hashes().items()}
    assert check_repeated_files(data, hashes, ["left"]) == {"left": []}
    copy = replace(data.frames[0], index=3, name="copy")
    copied = replace(data, frames=(*data.frames, copy))
    (check,) = check_repeated_files(copied, hashes, ["left"])["left"]
    assert (check.name, check.status) == ("equal files", "WARN")
    assert "000000 and copy have the same image of left" in check.text
    image = {"left": data.frames[0].image_paths["left"]}
    frozen = [replace(frame, image_paths=frame.image_paths | image) for frame in data.frames]
    found = check_repeated_files(replace(data, frames=frozen), hashes, ["left", "front_left"])
    (check,) = found["left"]
    assert check.text == (
        "frames 000000 and 000001 have the same image of left, and 1 more repeat one; leave "
        "repeats out"
    )
    assert found["front_left"] == []


def copies(table: Correspondences, number: int) -> Correspondences:
    """A table of one frame, and copies of it under other numbers."""
    frames = [np.full(len(table), k, dtype=np.int64) for k in range(number)]
    return concatenate([replace(table, frame=frame) for frame in frames])


def test_copies_of_a_frame_count_as_one_frame(pair: Rig) -> None:
    one = simulated(pair, frames=1)
    result, alone = solve(pair, copies(one, 12)), solve(pair, one)
    for name, covariance in alone.covariance.items():
        np.testing.assert_allclose(result.covariance[name], covariance, rtol=1e-6, atol=1e-15)
    assert result.verdict.status != "PASS"
    assert result.counts["left"]["frames"] == 1
    assert result.counts["left"]["repeated_frames"] == 11
    for name, T in alone.T_camera_lidar.items():
        np.testing.assert_allclose(result.T_camera_lidar[name], T, atol=1e-9)
    reasons = " ".join(check.text for check in result.camera_verdicts["left"].checks)
    assert "they count as one frame each" in reasons


def test_a_cloud_that_was_matched_again_counts_once(pair: Rig) -> None:
    """Ten copies of each of three frames, with matches of their own, of most points."""
    table, rng = simulated(pair, frames=3), np.random.default_rng(0)
    parts = []
    for copy in range(10):
        noise = 0.1 * rng.standard_normal(table.pixels_px.shape)
        again = replace(table, frame=table.frame + 3 * copy, pixels_px=table.pixels_px + noise)
        parts.append(again.select(rng.random(len(table)) < 0.9))
    result, alone = solve(pair, concatenate(parts)), solve(pair, table)
    for name in pair.cameras:
        assert result.counts[name]["frames"] == 3 and result.counts[name]["repeated_frames"] == 27
        sigmas = [np.sqrt(np.diag(each.covariance[name])) for each in (result, alone)]
        assert (sigmas[0] > 0.5 * sigmas[1]).all()  # as independent frames: a third and less


def stuck_camera(table: Correspondences, *, first: int) -> Correspondences:
    """The table with the image of a frame in all later ones, while the LiDAR moves 12 cm and on."""
    parts = [table.select(table.frame <= first)]
    image = table.select(table.frame == first)
    for number in range(first + 1, int(table.frame.max()) + 1):
        ahead = np.array([0.12 + 0.002 * number, 0.0, 0.0])
        frame = np.full(len(image), number, dtype=np.int64)
        parts.append(replace(image, frame=frame, points_lidar_m=image.points_lidar_m - ahead))
    return concatenate(parts)


def test_frames_of_a_stuck_camera_count_as_one(pair: Rig) -> None:
    """Twelve of fifteen frames agree on a pose 15 cm off, by one image."""
    result = solve(pair, stuck_camera(simulated(pair, frames=15), first=3))
    for name, verdict in result.camera_verdicts.items():
        assert result.counts[name]["repeated_frames"] == 11
        assert verdict.status != "PASS"
        assert any("a camera or the LiDAR was stuck" in text for text in verdict.reasons)


def test_copies_do_not_narrow_the_error_bar(pair: Rig) -> None:
    table = simulated(pair, frames=8)
    last = table.select(table.frame == 7)
    more = copies(last, 20).select(slice(len(last), None))
    more = replace(more, frame=more.frame + 7)
    with_copies, plain = (solve(pair, t) for t in (concatenate([table, more]), table))
    for name in pair.cameras:
        np.testing.assert_allclose(
            with_copies.covariance[name], plain.covariance[name], rtol=1e-6, atol=1e-15
        )


def test_frames_of_one_place_count_as_one_frame(pair: Rig) -> None:
    """Named in the metadata, as by ``calibrate`` where the vehicle stands."""
    table = simulated(pair, frames=10)
    standing = replace(table, metadata={**table.metadata, "stationary": [[2, 3, 4], [7, 9]]})
    result = solve(pair, standing)
    assert result.counts["left"]["frames"] == 7 and result.counts["left"]["repeated_frames"] == 3
    with pytest.raises(CorrespondenceError, match="stationary"):
        replace(table, metadata={**table.metadata, "stationary": [[2, "3"]]})

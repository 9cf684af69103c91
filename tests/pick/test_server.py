"""The server of the page, what outlives it, and what pairs determine."""

import http.client
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from calibgraph import CalibrationError, Rig, load_dataset, load_rig
from calibgraph.model.geometry import twist_between
from calibgraph.pick.estimate import MIN_PAIRS, Pair, estimate_from_pairs, reference_rig
from calibgraph.pick.server import PickServer, Workspace, visible_points
from calibgraph.simulation.rigs import rig_of
from tests.conftest import SAMPLE, Call, require_near

CAMERA = "front_left"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[PickServer]:
    with PickServer(Workspace(load_dataset(SAMPLE), tmp_path), 0) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield server
        server.shutdown()


def ask(url: str, path: str, body: object = None, **headers: str) -> tuple[int, bytes]:
    parts = urlsplit(url)
    method = "GET" if body is None else "POST"
    data = None if body is None else json.dumps(body)
    with closing(http.client.HTTPConnection(parts.netloc, timeout=30)) as connection:
        connection.request(method, parts.path + path, data, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()


def true_pair(number: int) -> dict[str, Any]:
    """A pair of a point and where it really is in the image."""
    frame = load_dataset(SAMPLE).frames[number % 2]
    points, truth = frame.load_cloud()[:, :3].astype(float), load_rig(SAMPLE / "reference.yaml")
    camera = truth.cameras[CAMERA]
    T = camera.T_camera_lidar
    pixels, valid = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
    inside = np.flatnonzero(valid & camera.in_image(pixels))
    one = int(np.random.default_rng(number).choice(inside))
    return {
        "frame": number % 2, "camera": CAMERA, "pixel_px": pixels[one].tolist(),
        "point_lidar_m": points[one].tolist(),
    }  # fmt: skip


def test_the_page_has_image_cloud_and_points(server: PickServer) -> None:
    status, page = ask(server.url, "")
    assert status == 200 and b"main.js" in page
    assert b"http:" not in page and b"https:" not in page  # nothing is fetched
    state = json.loads(ask(server.url, "session")[1])
    assert list(state["cameras"]) == ["front_left", "front_right", "left"]
    cloud = np.frombuffer(ask(server.url, "cloud/0")[1], "<f4").reshape(-1, 4)
    assert np.isfinite(cloud[:, :3]).all() and len(cloud) > 1000
    assert ask(server.url, f"image/0/{CAMERA}")[1][:2] == b"\xff\xd8"
    shown = np.frombuffer(ask(server.url, f"projected/0/{CAMERA}")[1], "<f4").reshape(-1, 3)
    camera = load_dataset(SAMPLE).rig.cameras[CAMERA]
    np.testing.assert_array_equal(shown, visible_points(cloud[:, :3].astype(float), camera))


@pytest.mark.parametrize(
    ("path", "body", "headers", "expected"),
    [
        ("session", None, {"Host": "evil.example"}, 403),
        ("pairs", [], {"Origin": "http://evil.example"}, 403),
        ("../session", None, {}, 400),
        ("main.py", None, {}, 400),
        ("..%2fserver.py", None, {}, 400),
        ("cloud/99", None, {}, 400),
        ("image/0/nobody", None, {}, 400),
        ("pairs", {"a": 1}, {}, 400),
        ("pairs", [{**true_pair(0), "frame": 77}], {}, 400),
        ("pairs", [{**true_pair(0), "pixel_px": [1e300, 0]}], {}, 400),
        ("pairs", ["x" * 2**21], {}, 400),
        ("write", {}, {}, 400),
    ],
)
def test_wrong_requests_are_refused_and_change_nothing(
    server: PickServer, path: str, body: object, headers: dict[str, str], expected: int
) -> None:
    try:
        status, text = ask(server.url, path, body, **headers)
        assert status == expected and b"\n" not in text
    except (BrokenPipeError, ConnectionResetError):  # refused before it was sent whole
        assert path == "pairs"
    assert server.workspace.session.pairs == ()
    assert ask(server.url.replace(server.key, "guess"), "session")[0] == 404


def test_ten_pairs_give_a_reference_that_evaluate_compares_in_sigmas(
    server: PickServer, tmp_path: Path, call: Call
) -> None:
    assert ask(server.url, "pairs", [true_pair(k) for k in range(10)])[0] == 200
    status, text = ask(server.url, "write", {})
    assert status == 200, text
    estimate, rig = tmp_path / "rig.yaml", load_rig(SAMPLE / "rig.yaml")
    rig.model_copy(update={"cameras": {CAMERA: rig.cameras[CAMERA]}}).save(estimate)
    found = json.loads(call("evaluate", estimate, tmp_path / "reference.yaml", "--json")[1])
    assert found["deviations"][CAMERA]["of"] == "reference"
    assert found["deviations"][CAMERA]["p"] < 1e-6  # the guess is 2 degrees off


@pytest.mark.slow
def test_what_was_answered_outlives_kill_9(tmp_path: Path) -> None:
    words = ["pick", str(SAMPLE), "--out", str(tmp_path), "--no-show"]
    for expected, ends in ((0, signal.SIGKILL), (1, signal.SIGINT)):
        with subprocess.Popen(
            [sys.executable, "-m", "calibgraph", *words], stderr=subprocess.PIPE, text=True
        ) as process:
            assert process.stderr is not None
            url = process.stderr.readline().partition(": ")[0]
            try:
                assert len(json.loads(ask(url, "session")[1])["pairs"]) == expected
                assert ask(url, "pairs", [true_pair(0)])[0] == 200
                process.send_signal(ends)
                process.wait(20)
            finally:
                process.kill()
    assert process.returncode in (0, 130)


def draw_pairs(
    rig: Rig, camera: str, count: int, rng: np.random.Generator, noise_px: float
) -> list[Pair]:
    """Pairs of points in view, at 4 to 30 m, in two frames in turn."""
    seen, T, found = rig.cameras[camera], rig.T_camera_lidar[camera], list[Pair]()
    while len(found) < count:
        direction = rng.normal(size=3)
        direction[2] *= 0.2
        point = direction / np.linalg.norm(direction) * np.exp(rng.uniform(np.log(4), np.log(30)))
        pixels, valid = seen.lens.project((T[:3, :3] @ point + T[:3, 3])[None])
        if not valid[0] or not seen.in_image(pixels)[0]:
            continue
        u, v = (pixels[0] + noise_px * rng.standard_normal(2)).tolist()
        x, y, z = point.tolist()
        pair = {"frame": len(found) % 2, "camera": camera}
        found.append(Pair(**pair, pixel_px=(u, v), point_lidar_m=(x, y, z)))
    return found


@pytest.mark.parametrize("name", ["kitti", "fisheye", "omni"])
def test_exact_pairs_give_the_truth_without_a_guess(name: str) -> None:
    rig, rng = rig_of(name), np.random.default_rng(0)
    pairs = [pair for camera in rig.cameras for pair in draw_pairs(rig, camera, 16, rng, 0.0)]
    away = rig.moved_to({name: np.eye(4) for name in rig.cameras})
    found = reference_rig(estimate_from_pairs(away, pairs))
    require_near(found, rig, deg=1e-4, cm=1e-3)


@pytest.mark.statistics
@pytest.mark.parametrize("count", [6, 12])
def test_the_error_bar_is_the_scatter_of_pickers(count: int) -> None:
    """Two cameras, 40 pickers: the mean of 80 NEES / 6 is known to 1 / sqrt(240), and by Student's
    law of six pairs to a few times that."""
    rig, nees = rig_of("kitti"), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        pairs = [p for camera in rig.cameras for p in draw_pairs(rig, camera, count, rng, 1.0)]
        found = reference_rig(estimate_from_pairs(rig, pairs))
        for camera, one in found.cameras.items():
            xi = twist_between(one.T_camera_lidar, rig.T_camera_lidar[camera])
            nees.append(xi @ np.linalg.solve(np.array(one.covariance), xi) / 6)
    assert 0.6 < np.mean(nees) < 1.6


def test_a_wrong_pair_is_marked_and_a_right_one_is_not() -> None:
    rig, rng = rig_of("kitti"), np.random.default_rng(3)
    pairs = draw_pairs(rig, "image_2", 12, rng, 1.0)
    assert not any(estimate_from_pairs(rig, pairs)[1]["image_2"].wrong)
    u, v = pairs[4].pixel_px
    pairs[4] = pairs[4].model_copy(update={"pixel_px": (u + 60.0, v - 25.0)})
    wrong = estimate_from_pairs(rig, pairs)[1]["image_2"].wrong
    assert wrong[4]


def test_too_few_pairs_and_pairs_on_one_line_give_no_camera() -> None:
    rig, rng = rig_of("kitti"), np.random.default_rng(1)
    few = draw_pairs(rig, "image_2", MIN_PAIRS - 1, rng, 0.0)
    estimate = estimate_from_pairs(rig, few)
    assert estimate[1]["image_2"].problem == "5 of 6 pairs"
    assert np.abs(estimate[1]["image_2"].residuals_px).max() < 1e-6  # of the guess
    line = [
        few[0].model_copy(update={"point_lidar_m": (4.0 + k, 0.5, 0.1)}) for k in range(MIN_PAIRS)
    ]
    estimate = estimate_from_pairs(rig, line)
    with pytest.raises(CalibrationError, match="image_2: its points lie on one line"):
        reference_rig(estimate)

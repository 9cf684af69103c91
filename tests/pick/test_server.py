"""The server of the page: what it answers, to whom, and what outlives it."""

from __future__ import annotations

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

from calibgraph import load_dataset, load_rig
from calibgraph.pick.server import PickServer
from calibgraph.pick.workspace import Workspace, visible_points
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call

CAMERA = "front_left"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[PickServer]:
    with PickServer(Workspace(load_dataset(SAMPLE), tmp_path), 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
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
            assert len(json.loads(ask(url, "session")[1])["pairs"]) == expected
            assert ask(url, "pairs", [true_pair(0)])[0] == 200
            process.send_signal(ends)
            process.wait(20)
    assert process.returncode in (0, 130)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nothing", "--out", "session"), "no such folder"),
        ((str(SAMPLE), "--out", "session", "--frames", "99"), "frames '99'"),
        ((str(SAMPLE), "--out", "other"), "session of other frames or cameras"),
        ((str(SAMPLE), "--out", "file"), "file"),
    ],
)
def test_what_cannot_be_picked_is_one_line(
    words: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    call: Call,
) -> None:
    monkeypatch.chdir(tmp_path)
    Workspace(load_dataset(SAMPLE, frames=":2"), tmp_path / "other").change([])
    (tmp_path / "file").write_text("of the user")
    assert message in error_line(*call("pick", *words, "--no-show"))
    assert (tmp_path / "file").read_text() == "of the user"

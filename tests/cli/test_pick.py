"""``calibgraph pick`` as a process, and what other commands make of its reference."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest

from calibgraph import load_dataset, load_rig
from calibgraph.service.pick.session import load_session
from calibgraph.service.pick.views import visible_points
from calibgraph.service.pick.workspace import Workspace
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call

CAMERA = "front_left"


@contextmanager
def picking(out: Path) -> Iterator[tuple[httpx.Client, subprocess.Popen[str]]]:
    """The command in a process of its own, and a client of it."""
    words = ["pick", str(SAMPLE), "--out", str(out), "--port", "0", "--no-show"]
    process = subprocess.Popen(
        [sys.executable, "-m", "calibgraph", *words], stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        address = process.stderr.readline().partition(": ")[0]
        transport = httpx.HTTPTransport(retries=20)  # it listens before it answers
        base = address.removesuffix("/pick")
        with httpx.Client(base_url=base, transport=transport, timeout=30) as client:
            yield client, process
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def post_true_pair(client: httpx.Client, number: int) -> None:
    """A pair of a point and where it really is in the image."""
    data, frame = load_dataset(SAMPLE), number % 2
    points = data.frames[frame].load_cloud()[:, :3].astype(float)
    seen = visible_points(points, load_rig(SAMPLE / "reference.yaml").cameras[CAMERA])
    one = int(np.random.default_rng(number).integers(len(seen.rows)))
    body = {
        "revision": client.get("/v1/pick/session").json()["revision"], "frame": frame,
        "camera": CAMERA, "pixel_px": seen.pixels_px[one].tolist(),
        "point_index": int(seen.rows[one]),
    }  # fmt: skip
    assert client.post("/v1/pick/pairs", json=body).status_code == 201


@pytest.mark.slow
def test_what_was_answered_outlives_kill_9(tmp_path: Path) -> None:
    with picking(tmp_path) as (client, process):
        post_true_pair(client, 0)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert len(load_session(tmp_path / "session.json").pairs) == 1
    with picking(tmp_path) as (client, process):
        assert len(client.get("/v1/pick/session").json()["pairs"]) == 1
        process.send_signal(signal.SIGINT)
        assert process.wait(20) in (0, 130)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reference of ten pairs, with error bars."""
    out = tmp_path_factory.mktemp("picked")
    from tests.service.pick.serving import serving

    workspace = Workspace(load_dataset(SAMPLE), out)
    with serving(workspace) as url, httpx.Client(base_url=url) as client:
        for number in range(10):
            post_true_pair(client, number)
        assert client.post("/v1/pick/reference").status_code == 200
    return out / "reference.yaml"


def test_evaluate_compares_with_a_picked_reference_in_sigmas(
    reference: Path, tmp_path: Path, call: Call
) -> None:
    estimate = tmp_path / "rig.yaml"
    rig = load_rig(SAMPLE / "rig.yaml")
    rig.model_copy(update={"cameras": {CAMERA: rig.cameras[CAMERA]}}).save(estimate)
    code, _, shown = call("evaluate", estimate, reference)
    assert code == 0
    assert "in standard deviations" in shown
    found = json.loads(call("evaluate", estimate, reference, "--json")[1])
    deviation = found["deviations"][CAMERA]
    assert deviation["of"] == "reference"
    assert max(map(abs, deviation["rotation"])) > 5  # the guess is 2 degrees off
    assert deviation["p"] < 1e-6


@pytest.mark.slow
def test_calibrate_starts_from_a_picked_reference(
    reference: Path, tmp_path: Path, call: Call
) -> None:
    code, _, shown = call("calibrate", SAMPLE, "--rig", reference, "--out", tmp_path / "out")
    assert code == 0, shown
    found = json.loads(call("evaluate", tmp_path / "out", reference, "--json")[1])
    assert found["deviations"][CAMERA]["of"] == "both"
    assert found["deviations"][CAMERA]["p"] > 1e-3


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
    other = Workspace(load_dataset(SAMPLE, frames=":2"), tmp_path / "other").session
    (tmp_path / "other").mkdir()
    other.save(tmp_path / "other" / "session.json")
    (tmp_path / "file").write_text("of the user")
    assert message in error_line(*call("pick", *words, "--no-show", "--port", "0"))
    assert (tmp_path / "file").read_text() == "of the user"

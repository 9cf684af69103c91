from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

import calibgraph
from calibgraph.io.dataset import load_dataset
from calibgraph.service.pick.views import visible_points
from calibgraph.service.pick.workspace import Workspace
from tests.conftest import SAMPLE
from tests.service.pick.serving import serving

CAMERA = "front_left"
API = "/v1/pick"


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(load_dataset(SAMPLE, frames=":2"), tmp_path)


@pytest.fixture
def client(workspace: Workspace) -> Iterator[httpx.Client]:
    with serving(workspace) as address, httpx.Client(base_url=address) as client:
        yield client


def add_true_pairs(client: httpx.Client, workspace: Workspace, count: int) -> None:
    """Pairs of pixels where the truth sees points of the clouds, over two frames."""
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml").cameras[CAMERA]
    rng = np.random.default_rng(0)
    for number in range(count):
        frame = number % 2
        seen = visible_points(workspace.cloud(frame)[:, :3].astype(float), truth)
        k = rng.integers(len(seen.rows))
        answer = client.post(
            f"{API}/pairs",
            json={
                "revision": client.get(f"{API}/session").json()["revision"],
                "frame": frame,
                "camera": CAMERA,
                "pixel_px": seen.pixels_px[k].tolist(),
                "point_index": int(seen.rows[k]),
            },
        )
        assert answer.status_code == 201, answer.text


def test_pairs_become_a_reference_that_the_library_reads(
    client: httpx.Client, workspace: Workspace
) -> None:
    add_true_pairs(client, workspace, 8)
    estimate = client.get(f"{API}/estimate", params={"frame": 0, "camera": CAMERA}).json()
    of_camera = next(one for one in estimate["cameras"] if one["camera"] == CAMERA)
    assert of_camera["rms_px"] < 0.01
    assert len(of_camera["pairs"]) == 8
    assert estimate["advice"]["words"]
    written = client.post(f"{API}/reference").json()
    assert written == {"files": ["picked.parquet", "reference.yaml"], "cameras": [CAMERA]}
    reference = calibgraph.load_rig(workspace.folder / "reference.yaml")
    assert reference.cameras[CAMERA].covariance is not None
    error = calibgraph.evaluate(reference, calibgraph.load_rig(SAMPLE / "reference.yaml"))
    assert error.cameras[CAMERA].rotation_error_deg < 1e-3
    table = calibgraph.load_correspondences(workspace.folder / "picked.parquet")
    solved = calibgraph.solve(reference, table)
    assert calibgraph.evaluate(solved.rig, reference).cameras[CAMERA].rotation_error_deg < 1e-3
    assert solved.rig.cameras[CAMERA].covariance is None  # it was that of the start


def test_every_change_is_on_disk_and_undone(client: httpx.Client, workspace: Workspace) -> None:
    add_true_pairs(client, workspace, 2)
    again = Workspace(workspace.dataset, workspace.folder)
    assert again.session == workspace.session
    assert len(again.session.pairs) == 2
    undone = client.post(f"{API}/undo", json={"revision": again.session.revision}).json()
    assert (len(undone["pairs"]), undone["can_redo"]) == (1, True)
    redone = client.post(f"{API}/redo", json={"revision": undone["revision"]}).json()
    changed = client.patch(
        f"{API}/pairs/0", json={"revision": redone["revision"], "used": False}
    ).json()
    assert [pair["used"] for pair in changed["pairs"]] == [False, True]
    left = client.post(f"{API}/pairs/0/remove", json={"revision": changed["revision"]}).json()
    assert len(left["pairs"]) == 1


def test_a_change_of_an_old_session_is_refused(client: httpx.Client, workspace: Workspace) -> None:
    add_true_pairs(client, workspace, 1)
    answer = client.post(f"{API}/undo", json={"revision": 0})
    assert answer.status_code == 409
    assert "another window" in answer.json()["detail"]


def test_images_clouds_and_points_are_those_of_the_dataset(
    client: httpx.Client, workspace: Workspace
) -> None:
    image = client.get(f"{API}/frames/0/images/{CAMERA}")
    assert image.content.startswith(b"\x89PNG")
    cloud = np.frombuffer(client.get(f"{API}/frames/1/cloud").content, "<f4").reshape(-1, 4)
    assert np.array_equal(cloud, workspace.cloud(1), equal_nan=True)
    seen = client.get(f"{API}/frames/1/visible/{CAMERA}").content
    assert len(seen) == 4 + 16 * np.frombuffer(seen, "<u4", 1)[0]
    assert "pixel_px" in client.get(f"{API}/frames/0/corner/{CAMERA}?u=100&v=100").json()


GOOD = {"revision": 0, "frame": 0, "camera": CAMERA, "pixel_px": [1, 1], "point_index": 0}
BAD = [
    ("get", "/frames/99/cloud", None, 422),
    ("get", "/frames/0/images/none", None, 422),
    ("get", "/frames/0/images/..%2F..%2Fetc", None, 404),
    ("get", "/frames/x/cloud", None, 422),
    ("get", f"/frames/0/corner/{CAMERA}?u=nan&v=1", None, 422),
    ("post", "/pairs", {"revision": 0}, 422),
    ("post", "/pairs", {**GOOD, "point_index": 10**9}, 422),
    ("post", "/pairs", {**GOOD, "camera": "none"}, 422),
    ("post", "/pairs", {**GOOD, "pixel_px": [1e9, 1]}, 422),
    ("patch", "/pairs/7", {"revision": 0, "used": False}, 404),
    ("post", "/pairs/7/remove", {"revision": 0}, 404),
    ("post", "/reference", None, 422),
]


@pytest.mark.parametrize(("method", "path", "body", "status"), BAD)
def test_bad_requests_are_refused_in_one_line(
    client: httpx.Client, method: str, path: str, body: dict[str, object] | None, status: int
) -> None:
    answer = client.request(method, API + path, json=body)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert "\n" not in answer.json()["detail"]


def test_the_page_and_its_files_come_with_strict_headers(client: httpx.Client) -> None:
    for path in ("/pick", "/static/pick/pick.js", "/static/pick/pick.css", "/static/pick/icon.svg"):
        answer = client.get(path)
        assert answer.status_code == 200
        assert "default-src 'self'" in answer.headers["content-security-policy"]
        assert "unsafe" not in answer.headers["content-security-policy"]


def test_other_names_and_other_sites_are_refused(client: httpx.Client) -> None:
    assert client.get("/pick", headers={"Host": "evil.example"}).status_code == 400
    headers = {"Origin": "http://evil.example"}
    assert client.post(f"{API}/reference", headers=headers).status_code == 403

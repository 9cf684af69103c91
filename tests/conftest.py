import contextlib
import fcntl
import gc
import io
import os
import pickle
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import (
    Camera,
    Intrinsics,
    MatcherErrors,
    RelativePose,
    Rig,
    doctor,
    evaluate,
    load_rig,
    rounds,
    simulate_correspondences,
)
from calibgraph.cli import app as cli
from calibgraph.cli import terminal
from calibgraph.simulation.world import INSTALL_LIBRARIES
from calibgraph.trust import assess, image_evidence, inputs
from tests.chromium import chromium
from tests.draws.cameras import camera_at

Call = Callable[..., tuple[int, str, str]]

gc.disable()  # while the tests are collected: their hundred thousands of objects stay

MEMORY = Path("/dev/shm")
if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > 4e9:  # a run writes 0.8 GB
    # Results and states are synced to disk, thousands of times in all: that costs nothing there.
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# A shell gives what it starts in the background no Ctrl-C, and that is inherited by every process.
signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "data" / "sample"

RADTAN5 = (-0.11, 0.05, 0.001, -0.002, 0.004)
RADTAN8 = (0.3, -0.1, 0.0005, 0.001, 0.02, 0.35, -0.05, 0.01)
KANNALA = (0.02, -0.004, 0.001, -0.0002)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests come first: at the end one process would wait for the other.

    Then ``io``, which compiles next to nothing, while the other process, which begins behind it,
    compiles kernels for both; and ``vehicle``, whose results only one process should make.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    early = {"io": 0, "vehicle": 1}

    def place(item: pytest.Item) -> tuple[bool, int]:
        return item.path not in slow, early.get(item.path.relative_to(ROOT).parts[1], 2)

    items.sort(key=place)


def pytest_collection_finish() -> None:
    """Let no later collection of garbage look at what has been imported and collected."""
    gc.freeze()
    gc.enable()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print one line for each reason why tests were skipped: what to install."""
    reports = terminalreporter.stats.get("skipped", [])
    reasons = Counter(report.longrepr[2].removeprefix("Skipped: ") for report in reports)
    for reason, tests in sorted(reasons.items()):
        terminalreporter.line(f"{tests} skipped: {reason}")


def make_camera(
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    yaw_deg: float = 0.0,
    model: str = "pinhole",
    distortion: tuple[float, ...] = (),
) -> Camera:
    """A camera of KITTI's size at a position in the LiDAR frame, turned left by ``yaw_deg``."""
    lens = Intrinsics(fx=718.0, fy=710.0, cx=607.0, cy=185.0)
    return camera_at((1240, 376), lens, position_m, yaw_deg, model=model, distortion=distortion)


def points_in_front(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) points in front of a camera that looks along the LiDAR's x axis."""
    distance = np.exp(rng.uniform(np.log(4), np.log(40), count))
    return distance[:, None] * np.column_stack(
        [np.ones(count), rng.uniform(-0.7, 0.7, count), rng.uniform(-0.2, 0.2, count)]
    )


def stereo_relative_pose(
    rig: Rig, a: str = "left", b: str = "right", *, sigmas: tuple[float, float] = (1e-3, 2e-3)
) -> RelativePose:
    """That of two cameras of a rig, known to ``sigmas`` [rad], [m]."""
    T_a_b = rig.T_camera_lidar[a] @ np.linalg.inv(rig.T_camera_lidar[b])
    return RelativePose(
        a=a, b=b, T_a_b=T_a_b, rotation_sigma_rad=sigmas[0], translation_sigma_m=sigmas[1]
    )


def require_poses(
    found: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray], *, atol: float
) -> None:
    """Check (4, 4) transforms of all names that are expected."""
    for name, T in expected.items():
        np.testing.assert_allclose(found[name], T, rtol=0, atol=atol, err_msg=name)


def require_near(found: Rig, truth: Rig, *, deg: float, cm: float) -> None:
    """Check the error of every camera."""
    for name, error in evaluate(found, truth).cameras.items():
        assert error.rotation_error_deg < deg and error.translation_error_cm < cm, name


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """Run the command line in this process: exit code, stdout, stderr without lines of progress."""
    monkeypatch.setattr(terminal, "LINE_EVERY_S", float("inf"))

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["calibgraph", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
            raise SystemExit(0)
        captured = capsys.readouterr()
        return int(exit_.value.code or 0), captured.out, captured.err

    return run


@dataclass(frozen=True)
class CommandRun:
    """A run of the command line that several tests share: what it printed and its folder."""

    code: int
    stdout: str
    stderr: str
    folder: Path


def run_command(*arguments: object, folder: Path) -> CommandRun:
    """Run the command line in this process, outside of a test's fixtures."""
    out, err = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as exit_,
    ):
        patch.setattr(sys, "argv", ["calibgraph", *map(str, arguments)])
        cli.main()
        raise SystemExit(0)
    return CommandRun(int(exit_.value.code or 0), out.getvalue(), err.getvalue(), folder)


@pytest.fixture(scope="session")
def calibrated_sample(tmp_path_factory: pytest.TempPathFactory) -> CommandRun:
    """``calibrate`` of the sample, with matches that are the truth and a pixel of noise.

    Processes of pytest-xdist share it: the first makes it, and the others wait.
    """
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "calibrated_sample"
    folder.mkdir(exist_ok=True)
    done = folder / "run.pickle"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            done.write_bytes(pickle.dumps(calibrate_sample(folder)))
    run: CommandRun = pickle.loads(done.read_bytes())
    return run


def calibrate_sample(folder: Path) -> CommandRun:
    truth = load_rig(SAMPLE / "reference.yaml")
    table = simulate_correspondences(truth, frames=6, errors=MatcherErrors(outlier_share=0.1))
    table.save(folder / "table.parquet")
    result = folder / "result"
    return run_command(
        "calibrate", SAMPLE, "--matcher", folder / "table.parquet", "--out", result, folder=result
    )


@pytest.fixture
def no_image_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not check results, guesses and other images against the images, for tests of all else."""
    monkeypatch.setattr(image_evidence, "check_images", lambda *_, **__: [])
    for module in (assess, inputs):
        monkeypatch.setattr(module, "likely_intended_guess", lambda *_: None)
    monkeypatch.setattr(rounds, "require_different_images", lambda *_: None)
    monkeypatch.setattr(doctor, "find_same_images", lambda *_: [])
    for module in (rounds, doctor):
        monkeypatch.setattr(module, "hide_burnt_in", lambda data, _: data)


def make_pair() -> Rig:
    """Two cameras side by side, without distortion."""
    return Rig(
        cameras={
            "left": make_camera((0.3, 0.1, -0.1)),
            "right": make_camera((0.3, -0.4, -0.1)),
        }
    )


@pytest.fixture
def pair() -> Rig:
    """Two cameras side by side, without distortion."""
    return make_pair()


@pytest.fixture
def mixed_rig() -> Rig:
    """Three cameras with three lenses, one of them looking sideways."""
    return Rig(
        cameras={
            "front": make_camera((0.3, 0.1, -0.1), distortion=RADTAN5),
            "wide": make_camera((0.2, -0.2, -0.1), distortion=RADTAN8),
            "side": make_camera((0.0, 0.4, -0.1), yaw_deg=80, model="fisheye", distortion=KANNALA),
        }
    )


@pytest.fixture(scope="session")
def truth() -> Rig:
    """The sample's rig at its true poses."""
    return load_rig(SAMPLE / "reference.yaml")


@pytest.fixture(scope="session")
def open3d() -> Any:
    """Open3D, which simulates sensors, and loads libraries of the system."""
    return pytest.importorskip(
        "open3d", reason=f"no libraries of Open3D: {INSTALL_LIBRARIES}", exc_type=ImportError
    )


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium, which would take processor time until the end of the session."""
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="session")
def realdata() -> Path:
    """The real sensor data: $CALIBGRAPH_REALDATA, or a folder beside the checkout."""
    path = Path(os.environ.get("CALIBGRAPH_REALDATA", ROOT.parent / "shared" / "realdata"))
    if not path.is_dir():
        pytest.skip(f"no real data at {path}; set CALIBGRAPH_REALDATA to run this")
    return path


@pytest.fixture(scope="session")
def reference_folder() -> Path:
    """Test vectors of the original network."""
    default = ROOT.parent / "shared" / "reference"
    folder = Path(os.environ.get("CALIBGRAPH_REFERENCE", default))
    if not (folder / "cmrnext_golden.npz").is_file():
        pytest.skip(f"no real data at {folder}; set CALIBGRAPH_REFERENCE to run this")
    return folder

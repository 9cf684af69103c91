"""Tables for 80 columns: names fold, numbers are never cut."""

import io
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from rich.table import Table

import calibgraph
from calibgraph import Rig, simulate_correspondences
from calibgraph.audit import Audit, CameraAudit, Drift
from calibgraph.audit import page as audit_tables
from calibgraph.model.calibration import Calibration, Residuals
from calibgraph.model.lens import LensEstimate
from calibgraph.model.metrics import Deviation, Evaluation, PoseError
from calibgraph.model.rig import Lidar, Vehicle
from calibgraph.model.verdict import ErrorProbability, Verdict
from calibgraph.report import tables

NAMES = ("camera_at_the_front_of_the_vehicle_looking_left_image_rectified_color", "rear")
TWIST = np.repeat([np.radians(-179.999), -12345.6789], 3)
COVARIANCE = np.diag(TWIST**2)


@pytest.fixture(scope="module")
def extreme() -> Calibration:
    """A result of cameras with long names, whose numbers are as large as can be."""
    from tests.conftest import make_pair

    rig = Rig(cameras=dict(zip(NAMES, make_pair().cameras.values(), strict=True)))
    result = calibgraph.solve(rig, simulate_correspondences(rig, frames=5, matches=60))
    far = rig.moved_to({name: _moved(T) for name, T in rig.T_camera_lidar.items()})
    lens = LensEstimate("distortion_k1", "px", -12345.678, 0.012, 718.856, 14.4, "x (right)", 0.98)
    return replace(
        result,
        initial_rig=far,
        camera_verdicts=dict.fromkeys(NAMES, Verdict((), ErrorProbability(0.001, 0.98))),
        covariance=dict.fromkeys(NAMES, COVARIANCE),
        residuals=dict.fromkeys(NAMES, Residuals(12345.678, 1.0, 1.0, 1.0, 1.0)),
        counts=dict.fromkeys(NAMES, {"used": 12_345_678, "frames_used": 100_000}),
        lens=dict.fromkeys(NAMES, (lens,)),
    )


def _moved(T: np.ndarray) -> np.ndarray:
    turned = np.diag([-1.0, -1.0, 1.0, 1.0]) @ T
    turned[:3, 3] += [0.0, 0.0, 12345.6]
    return turned


def evaluation() -> Evaluation:
    """Errors as large as can be."""
    error = PoseError(179.999, 1234567.89, *[-1234567.89] * 3, *[-179.999] * 3)
    sigmas = (-12345.67,) * 3
    found = Deviation(sigmas, sigmas, 1.2e-308, "reference")
    return Evaluation(dict.fromkeys(NAMES, error), {"->".join(NAMES): error},
                      dict.fromkeys(NAMES, found))  # fmt: skip


def with_lidars(extreme: Calibration) -> Calibration:
    """The same numbers of LiDARs."""
    base, other = (f"lidar_{name}" for name in NAMES)
    far = Lidar(T_base_lidar=_moved(np.eye(4)), covariance=COVARIANCE)
    turns = tuple(map(abs, TWIST[:3].tolist()))
    vehicle = Vehicle(
        T_vehicle_lidar=_moved(np.eye(4)), rotation_sigma_rad=turns, translation_sigma_m=12345.678
    )
    known = {"lidar": base, "lidars": {base: Lidar(), other: far}, "vehicle": vehicle}
    guess = {"lidar": base, "lidars": {base: Lidar(), other: Lidar(T_base_lidar=np.eye(4))}}
    return replace(
        extreme,
        rig=extreme.rig.model_copy(update=known),
        initial_rig=extreme.rig.model_copy(update=guess),
        lidar_verdicts={other: Verdict((), ErrorProbability(0.001, 0.98))},
    )


def audit(extreme: Calibration) -> Audit:
    """One that cannot tell."""
    camera = CameraAudit("CANNOT TELL", "a reason", TWIST.copy(), -TWIST, -TWIST)
    unknown = CameraAudit("WRONG", "a reason")
    shown = object()
    return Audit(
        dict(zip(NAMES, (camera, unknown), strict=True)), None, extreme.rig,
        shown, ("drive",), 0.5, 10.0, 30,  # type: ignore[arg-type]
    )  # fmt: skip


def drift() -> Drift:
    """Of two results with long names."""
    one = CameraAudit("CANNOT TELL", "a reason", TWIST.copy(), -TWIST, -TWIST)
    results = ("recordings/2026-03-01_monday_morning", "recordings/2026-03-02_tuesday")
    return Drift(results, dict.fromkeys(NAMES, (one, one)), (None, None), 0.5, 10.0, 0.01)


TABLES: dict[str, Callable[[Calibration], Table]] = {
    "result_table": tables.result_table,
    "error_bar_table": tables.error_bar_table,
    "lens_table": tables.lens_table,
    "lidar_table": lambda result: tables.lidar_table(with_lidars(result)),
    "vehicle_table": lambda result: tables.vehicle_table(with_lidars(result)),
    "evaluation_table": lambda _: tables.evaluation_table(evaluation()),
    "deviation_table": lambda _: tables.deviation_table(evaluation()),
    "audit_table": lambda result: audit_tables.audit_table(audit(result)),
    "drift_table": lambda _: audit_tables.drift_table(drift()),
}


@pytest.mark.parametrize("name", TABLES)
def test_names_fold_and_words_and_numbers_are_whole_on_80_columns(
    name: str, extreme: Calibration
) -> None:
    table, out = TABLES[name](extreme), io.StringIO()
    Console(file=out, width=80).print(table)
    text = out.getvalue()
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    assert all(len(line) <= 80 for line in text.splitlines())
    rows = [line.split() for line in text.splitlines()]
    cells = [str(cell) for column in table.columns if column.no_wrap for cell in column.cells]
    numbers = [cell for cell in cells if cell[-1:].isdigit() or cell.endswith("%")]
    assert numbers
    for cell in numbers:
        assert any(set(cell.split()) <= set(row) for row in rows), cell

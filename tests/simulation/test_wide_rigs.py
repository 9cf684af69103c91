"""Rendered rigs that see all round are calibrated, by the images and by a table."""

from __future__ import annotations

from pathlib import Path

import pytest

import calibgraph
from calibgraph import evaluate, load_rig, perturb, simulate_correspondences, simulate_street, solve
from calibgraph.simulation.rigs import rig_of

pytestmark = pytest.mark.usefixtures("open3d")


@pytest.mark.parametrize("name", ["omni", "panorama"])
def test_a_table_of_a_rig_that_sees_all_round_is_solved(name: str) -> None:
    rig = rig_of(name)
    table = simulate_correspondences(rig, frames=5, matches=400)
    result = solve(perturb(rig, rotation_deg=5, translation_m=0.3, seed=1), table)
    assert result.verdict.status == "PASS"
    for error in evaluate(result.rig, rig).cameras.values():
        # 1 px of 300 px/rad over 2000 matches: 0.2 deg / 45, and as much of 10 m.
        assert error.rotation_error_deg < 0.03
        assert error.translation_error_cm < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fisheye", "omni", "panorama"])
def test_a_rendered_rig_that_sees_all_round_is_calibrated(name: str, tmp_path: Path) -> None:
    """Errors of more frames, from near and far, are in benchmarks/notes/simulation.md."""
    simulate_street(
        tmp_path / "street", rig_of(name), frames=5, seed=3, rotation_deg=8.0, translation_m=0.5
    )
    result = calibgraph.calibrate(tmp_path / "street")
    assert result.verdict.status == "PASS"
    truth = load_rig(tmp_path / "street" / "reference.yaml")
    for error in evaluate(result.rig, truth).cameras.values():
        assert error.rotation_error_deg < 0.06
        assert error.translation_error_cm < 1.5

"""The diagrams of one camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from calibgraph import Calibration, Rig
from calibgraph.report import plots
from calibgraph.report.camera_section import camera_diagrams
from calibgraph.report.match_errors import BeforeAfter
from calibgraph.report.reprojection_errors import errors_before_after
from tests.conftest import make_camera
from tests.report.conftest import solve_simulated, write_page

NASTY = "<b>x&\"y'<b>"


@pytest.mark.parametrize(("count", "gate_px"), [(0, 1e3), (1, 1e-9), (1, 1e3)])
def test_diagrams_of_hardly_any_matches_are_drawn(
    solved_pair: Calibration, count: int, gate_px: float
) -> None:
    """Inside the gate, and beyond it."""
    after = errors_before_after(solved_pair)["left"].after
    few = replace(after.select(np.arange(len(after.frame)) < count), gate_px=gate_px)
    drawn = camera_diagrams(solved_pair, "left", BeforeAfter(few, few))
    assert len(set(drawn.values())) == 6


def test_the_legend_of_the_convergence_covers_no_point(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(plots, "to_data_uri", lambda figure: drawn.append(figure) or "")
    still = {"moved_deg": 1e-3, "moved_cm": 5.0, "matches": 100}  # the upper curve ends on top
    plots.convergence([{**still, "moved_deg": 1e-2}, still, still])
    (figure,) = drawn
    figure.canvas.draw()
    axes, legend = figure.axes[0], figure.axes[0].get_legend()
    box = legend.get_window_extent()
    assert box.y1 <= figure.bbox.y1  # inside the picture
    assert {line.get_label() for line in axes.lines} == {"turned [deg]", "shifted [cm]"}
    for line in axes.lines:
        assert not any(
            box.contains(*point) for point in line.get_transform().transform(line.get_xydata())
        )


def test_names_of_cameras_are_escaped_and_drawn_as_they_are(tmp_path: Path) -> None:
    rig = Rig(cameras={NASTY: make_camera(), "$x_1$": make_camera((0, 0.5, 0))})
    text = write_page(solve_simulated(rig), tmp_path)
    assert "<b>x" not in text
    assert "&lt;b&gt;x&amp;&#34;y&#39;&lt;b&gt;" in text
    assert "$x_1$" in text


def test_a_change_of_the_lens_is_drawn_where_it_was_estimated(solved_pair: Calibration) -> None:
    """Of a lens that was not free there is no picture; a clock has none, either."""
    assert "lens" not in camera_diagrams(solved_pair, "left", None)
    camera = solved_pair.rig.cameras["left"]
    k = camera.intrinsics_px
    longer = k.model_copy(update={"fx": 1.01 * k.fx, "fy": 1.01 * k.fy})
    cameras = {
        **solved_pair.rig.cameras,
        "left": camera.model_copy(update={"intrinsics_px": longer}),
    }
    moved = replace(
        solved_pair,
        rig=solved_pair.rig.model_copy(update={"cameras": cameras}),
        lens={name: () for name in cameras},
    )
    lens = (camera_diagrams(moved, "left", None))["lens"]
    assert lens.startswith("data:image/png;base64,")
    assert "lens" not in camera_diagrams(moved, "right", None)

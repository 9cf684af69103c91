"""The diagrams of one camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from calibgraph import Calibration, Rig
from calibgraph.report.camera_section import camera_diagrams
from tests.conftest import make_camera
from tests.report.conftest import solve_simulated, write_page

NASTY = "<b>x&\"y'<b>"


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

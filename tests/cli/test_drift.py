"""drift: its exit codes, table and JSON."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.audit.drifting import draw, template, twist
from tests.cli.conftest import error_line
from tests.conftest import Call


@pytest.fixture(scope="module")
def week(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of five days, in the last of which a camera has turned; and a wide one."""
    folder, rng = tmp_path_factory.mktemp("week"), np.random.default_rng(0)
    for day in ("mon", "tue", "wed", "thu"):
        draw(rng).save(folder / day)
    draw(rng, {"left": twist("yaw", 1.0)}).save(folder / "fri")
    draw(rng, wider=24.0).save(folder / "fog")
    return folder


def test_results_that_agree_exit_with_0_and_the_json_names_its_units(
    call: Call, week: Path
) -> None:
    code, out, err = call("drift", *(week / day for day in ("mon", "tue", "wed")), "--json")
    assert (code, err) == (0, "")
    content = json.loads(out)
    assert content["status"] == "OK"
    assert content["results"] == ["mon", "tue", "wed"]
    each = content["cameras"]["left"]["results"]["tue"]
    keys = {f"{k}_{u}" for k in ("deviation", "sigma", "detectable") for u in ("deg", "cm")}
    assert set(each) == {"status", "reason", "axes", *keys}
    assert all(len(each[key]) == 3 for key in keys)


def test_a_turned_camera_exits_with_1_and_is_named_with_its_axis(call: Call, week: Path) -> None:
    """Results may be given as files, too."""
    days = [week / day / "calibration.yaml" for day in ("mon", "tue", "wed", "thu", "fri")]
    code, out, err = call("drift", *days)
    assert (code, out) == (1, "")
    lines = err.splitlines()
    assert lines[0].startswith("CHANGED  drift: ")
    assert lines[1].startswith("  CHANGED fri, left: turned about y (yaw) by +")
    assert not lines[2].startswith("  CHANGED")
    assert lines[-1] == "nothing was written"
    assert "x right y down z ahead" in err  # no heading is cut


def test_a_wide_error_bar_exits_with_3(call: Call, week: Path) -> None:
    code, _, err = call("drift", week / "mon", week / "fog")
    assert code == 3
    assert err.startswith("CANNOT TELL  drift: does one of the results deviate from the others?\n")


def test_bad_input_is_one_line(call: Call, week: Path, tmp_path: Path) -> None:
    mon, tue = week / "mon", week / "tue"
    cases = {
        (mon,): "1 result given; a comparison needs two or more",
        (mon, mon): "is the same result as",
        (mon, tmp_path / "none"): "none",
        (mon, tue, "--tolerance-deg", "0"): "tolerance_deg must be positive",
    }
    for arguments, words in cases.items():
        assert words in error_line(*call("drift", *arguments))
    rig = tmp_path / "rig.yaml"
    template().rig.save(rig)
    assert "expected calibgraph-calibration/1" in error_line(*call("drift", mon, rig))

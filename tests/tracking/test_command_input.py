"""The command `track` with wrong input."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from calibgraph import (
    Correspondences,
)
from tests.conftest import Call
from tests.tracking.drives import (
    World,
    as_lines,
    content_of,
    expected_lines,
    left_out,
)

pytestmark = pytest.mark.usefixtures("no_picture")


# Wrong input


def wrong_lines(good: Correspondences) -> dict[str, bytes]:
    """What is no frame, or a frame that cannot be taken, each with its number before the good."""

    def line(**changes: Any) -> bytes:
        content = content_of(good)
        content["frame"] += 1
        camera = content["cameras"]["left"]
        for key, value in changes.items():
            if key in camera:
                camera[key][3] = value
            else:
                content[key] = value
        return json.dumps(content).encode()

    content = content_of(good)
    return {
        "is not JSON (EOF": line()[:200],
        "not in the rig": line(cameras={"stranger": content["cameras"]["left"]}),
        "comes again": line(frame=content["frame"]),
        "comes after": line(frame=-1),
        "is not JSON (expected": line(z_m=float("inf")),
        "below 1e+06, found [1000000.0": line(u_px=1e6),
        "confidence must lie in (0, 1]": line(confidence=1e30),
        "is missing": b'{"frame": 7}',
        "expected keys with values, as in {key: value}": b"[1, 2]",
        "is not JSON": b"\xff\xfe\xfa",
        "metadata systematic_rotation_rad": line(metadata={"systematic_rotation_rad": "much"}),
        "differ in length": b'{"frame": 7, "cameras": {"left": {"u_px": [1], "v_px": [],'
        b' "x_m": [], "y_m": [], "z_m": []}}}',
    }


def test_wrong_input_is_left_out_with_a_line_each_and_leaves_no_trace(
    world: World, piped: Callable[..., Any], tmp_path: Path
) -> None:
    """Frames 0, 10, 20, ...; after the seventh everything that can be wrong."""
    tables = [replace(table, frame=10 * table.frame) for table in world.tables]
    wrong = wrong_lines(tables[6])
    given = as_lines(tables[:7]) + b"\n".join(wrong.values()) + b"\n" + as_lines(tables[7:])
    half_a_line = as_lines(tables[:1])[:500]
    code, out, err = piped(world.rig, given + half_a_line, "--out", tmp_path / "out")
    assert code == 0
    assert out.splitlines() == expected_lines(world.guess, tables)
    messages = left_out(err)
    assert len(messages) == len(wrong) + 1
    for line, what in zip(messages, (*wrong, "is not JSON"), strict=True):
        assert what in line
    assert "Traceback" not in err


@pytest.mark.parametrize("option", [("--interval-s", 0.1), ("--motion", "scans")])
def test_options_for_clouds_are_refused_without_a_matcher(
    world: World, call: Call, tmp_path: Path, option: tuple[object, ...]
) -> None:
    out = tmp_path / "out"
    code, text, err = call("track", world.rig, world.source, "--out", out, *option)
    assert (code, text) == (2, "")
    assert f"{option[0]} goes with --matcher only" in err and err.count("\n") == 1
    assert not out.exists()


def test_a_lens_or_clock_is_refused_while_driving(world: World, call: Call, tmp_path: Path) -> None:
    settings, out = tmp_path / "config.yaml", tmp_path / "out"
    settings.write_text("estimate: [offset]\n")
    code, text, err = call("track", world.rig, world.source, "--out", out, "--config", settings)
    assert (code, text) == (2, "") and err.count("\n") == 1
    assert "found offset: estimate them with `calibgraph solve`" in err
    assert not out.exists()

"""Wrong arguments of bench."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import error_line
from tests.conftest import Call


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bench", "paper", "nowhere"), "'nowhere' is no scenario (kitti, walkley"),
        (("bench", "paper", "kitti", "--frames", "ten"), "--frames ten: give whole numbers"),
        (("bench", "paper", "kitti", "--preset", "auto"), "--preset auto: give the paper's"),
        (("bench", "paper", "kitti", "--preset", "x"), "unknown preset 'x'"),
        (("bench", "paper", "kitti", "--frames", "10001"), "10001 frames: at most 10000"),
    ],
)
def test_wrong_arguments_are_one_line(
    arguments: tuple[str, ...], message: str, tmp_path: Path, call: Call
) -> None:
    assert message in error_line(*call(*arguments, "--out", tmp_path / "out.yaml"))
    assert not (tmp_path / "out.yaml").exists()

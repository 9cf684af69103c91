"""Option values become settings, matchers and terms."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibgraph import load_calibration
from calibgraph.cli.arguments import config_from, matcher_from, terms_from
from tests.conftest import Call


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A file of settings with a seed."""
    path = tmp_path / "config.yaml"
    path.write_text("preset: kitti\nseed: 7\n")
    return path


@pytest.mark.parametrize(("option", "seed"), [(None, 7), (0, 0), (3, 3)])
def test_a_given_seed_replaces_the_seed_of_the_file(
    option: int | None, seed: int, config: Path
) -> None:
    settings = config_from(config, None, seed=option)
    assert (settings.seed, settings.preset) == (seed, "kitti")


@pytest.mark.parametrize(("option", "seed"), [(None, 0), (3, 3)])
def test_presets_have_seed_0(option: int | None, seed: int) -> None:
    assert config_from(None, "walkley", seed=option).seed == seed


def test_seed_0_on_the_command_line_replaces_the_seed_of_the_file(
    problem: Path, config: Path, call: Call
) -> None:
    out = problem / "out"
    code, _, _ = call("solve", problem / "rig.yaml", problem / "table.parquet",
                      "--config", config, "--seed", 0, "--out", out)  # fmt: skip
    assert code == 0
    assert load_calibration(out).config.seed == 0


def test_options_of_the_other_matcher_are_refused() -> None:
    with pytest.raises(ValueError, match="--iterations is for --matcher cmrnext only"):
        matcher_from("structure", None, seed=0, iterations=3)
    with pytest.raises(ValueError, match="--weights is for --matcher cmrnext only"):
        matcher_from("structure", [Path("a.tar")], seed=0)
    with pytest.raises(ValueError, match="--device is for --matcher cmrnext only"):
        matcher_from("structure", None, seed=0, device="cpu")
    with pytest.raises(ValueError, match="needs weights"):
        matcher_from("cmrnext", None, seed=0, device="cpu")
    with pytest.raises(ValueError, match="--search-m is for --matcher structure only"):
        matcher_from("table.csv", None, seed=0, search_m="1")
    with pytest.raises(ValueError, match="--search-deg few: give a number, or none"):
        matcher_from("structure", None, seed=0, search_deg="few")


def test_terms_are_checked() -> None:
    assert terms_from("priors") == "priors"
    with pytest.raises(ValueError, match="--terms 'all': known are stage1, reprojection"):
        terms_from("all")

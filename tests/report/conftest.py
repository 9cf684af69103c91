import re
from dataclasses import replace
from pathlib import Path

import pytest

import calibgraph
from calibgraph import Calibration, MatcherErrors, Rig, perturb, simulate_correspondences
from calibgraph.report.html import write_report
from tests.conftest import CommandRun, make_pair

MAX_CHARACTERS = 6_000_000


def solve_simulated(rig: Rig, *, outlier_share: float = 0.15) -> Calibration:
    """A result of a simulated table, from 2 degrees and 0.2 m off."""
    errors = MatcherErrors(noise_px=1.0, outlier_share=outlier_share)
    table = simulate_correspondences(rig, frames=8, matches=200, errors=errors)
    guess = perturb(rig, rotation_deg=2, translation_m=0.2)
    return replace(calibgraph.solve(guess, table), correspondences=table)


def write_page(result: Calibration, folder: Path) -> str:
    """Write the page; it must refer to nothing outside of itself."""
    return read_page(write_report(result, folder / "report.html"))


def read_page(path: Path) -> str:
    """The text of a page; it must refer to nothing outside of itself."""
    text = path.read_text("utf-8")
    assert len(text) < MAX_CHARACTERS
    assert "http://" not in text and "https://" not in text
    assert set(re.findall(r'src="([^,"]*)', text)) <= {
        "data:image/png;base64", "data:image/jpeg;base64",
    }  # fmt: skip
    for target in re.findall(r'href="([^"]*)"', text):
        assert target == "data:," or f'id="{target.removeprefix("#")}"' in text
    assert "url(" not in text and "@import" not in text
    return text


@pytest.fixture(scope="session")
def solved_pair() -> Calibration:
    """Two cameras, 15 % outliers."""
    return solve_simulated(make_pair())


@pytest.fixture(scope="session")
def pair_without_outliers() -> Calibration:
    """Two cameras, noise alone."""
    return solve_simulated(make_pair(), outlier_share=0.0)


@pytest.fixture(scope="session")
def sample_result(calibrated_sample: CommandRun) -> Calibration:
    """The sample with its images and clouds, calibrated."""
    return calibgraph.load_calibration(calibrated_sample.folder)

"""The file of the error's sizes: its version, and that a table keeps what its matcher stated."""

from __future__ import annotations

import json
from importlib.resources import files

import numpy as np
import pytest

from calibgraph.matching.structure.matcher import StructureMatcher
from calibgraph.model.error_components import FORMAT, error_components
from calibgraph.model.findings import MatcherFindings


def test_every_part_of_the_file_says_how_it_was_got() -> None:
    text = (files("calibgraph.model") / "error_components.json").read_text(encoding="utf-8")
    content = json.loads(text)
    assert content["format"] == FORMAT
    parts = [*content["matchers"].values(), content["pairs"], content["frames"], content["sizes"]]
    assert all(len(part["how"]) > 20 for part in parts)


def test_the_matcher_states_its_part_in_its_tables() -> None:
    stated = MatcherFindings.from_metadata(StructureMatcher()._metadata(0, {}))
    for name, value in vars(error_components().matchers["structure"]).items():
        assert getattr(stated, name) == value


def test_bends_of_the_cloud_are_part_of_what_all_frames_share() -> None:
    stated = MatcherFindings(
        systematic_rotation_rad=5e-3, systematic_translation_m=0.05,
        elevation_rad=3e-3, scan_motion_m=0.12 * np.pi,
    )  # fmt: skip
    assert stated.rigid_sigmas == pytest.approx((4e-3, 0.04))
    assert MatcherFindings(elevation_rad=3e-3).rigid_sigmas == (0.0, 0.0)

"""The file of the error's sizes: its version, and that a table keeps what its matcher stated."""

from __future__ import annotations

import json
from importlib.resources import files

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

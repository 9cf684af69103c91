"""Fixtures of the tests of tracking: one simulated drive is shared by all."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from calibgraph import concatenate, perturb
from calibgraph.io.rigs import load_rig
from calibgraph.tracking import command
from tests.conftest import Call
from tests.tracking.drives import World, drive, expected_lines, file_lines, pair_of


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    folder = tmp_path_factory.mktemp("world")
    guess = perturb(pair_of(), rotation_deg=1, translation_m=0.1, seed=1)
    tables = drive(pair_of())
    guess.save(folder / "rig.yaml")
    guess = load_rig(folder / "rig.yaml")
    concatenate(tables).save(folder / "matches.parquet")
    lines, of_file = expected_lines(guess, tables), file_lines(guess, tables)
    return World(guess, folder / "rig.yaml", folder / "matches.parquet", tables, lines, of_file)


@pytest.fixture
def not_warmed_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loading ahead takes a second."""
    monkeypatch.setattr(command, "warm_up_tracker", lambda: None)


@pytest.fixture
def piped(monkeypatch: pytest.MonkeyPatch, call: Call) -> Call:
    """Run ``track RIG -`` with bytes, or a file, on standard input."""

    def run(rig: Path, given: Any, *options: object) -> tuple[int, str, str]:
        buffer = io.BytesIO(given) if isinstance(given, bytes) else given
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=buffer))
        return call("track", rig, "-", *options)

    return run

"""Settings of a training: from files, checked at once."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from calibgraph import FileError
from calibgraph.files import commented_defaults, load_model
from calibgraph.matching.cmrnext import TrainSettings
from tests.matching.cmrnext.training.tiny import TINY


@pytest.mark.parametrize(
    "wrong",
    [
        {"context": "foo"},
        {"width": 12},
        {"width": 100_000},
        {"rotation_deg": 0.0},
        {"rotation_deg": float("inf")},
        {"learning_rate": float("nan")},
        {"correlation_weight": 0.0, "correlation_steps": 5},
        {"crop_px": (32, 64)},
        {"crop_px": (129, 192)},
        {"fourier_levels": 50},
        {"steps": 0},
        {"surplus": 1},
    ],
)
def test_settings_that_cannot_be_trained_are_refused_at_once(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError) as caught:
        TINY.changed(**wrong)
    assert "\n" not in str(caught.value)


def test_settings_survive_a_file(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    for settings in (TINY, TrainSettings(crop_px=None)):
        settings.save(path)
        assert load_model(TrainSettings, path) == settings
    path.write_text("steps: 7\ncrop_px: [320, 960]\nlearning_rate: 1e-3\n")
    assert load_model(TrainSettings, path) == TrainSettings(steps=7, learning_rate=1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("step: 3", "unknown key 'step'"),
        ("steps: many", "steps: .*found 'many'"),
        ("crop_px: 320x960", "crop_px: .*found '320x960'"),
        ("crop_px: [10, 960]", "greater than or equal to 64, found 10"),
        ("crop_px: [321, 960]", "multiple of 2, found 321"),
        ("width: 12", "width 12"),
        ("- 3", "expected a mapping"),
    ],
)
def test_wrong_files_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(FileError, match=message) as caught:
        load_model(TrainSettings, path)
    assert "\n" not in str(caught.value)


def test_the_printed_defaults_are_the_defaults() -> None:
    text = commented_defaults(TrainSettings)
    assert TrainSettings.model_validate(yaml.safe_load(text)) == TrainSettings()
    lines = text.splitlines()
    for name in TrainSettings.model_fields:
        (at,) = [i for i, line in enumerate(lines) if line.startswith(f"{name}:")]
        assert lines[at - 1].startswith("# ")

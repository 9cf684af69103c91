"""The settings of a training of seconds, and a scene."""

from __future__ import annotations

from calibgraph import Dataset
from calibgraph.matching.cmrnext import TrainSettings
from calibgraph.matching.cmrnext.training.samples import Scene

TINY = TrainSettings(
    rotation_deg=1.0,
    translation_m=0.1,
    steps=4,
    batch=1,
    iterations=2,
    crop_px=(128, 192),
    width=8,
    correlation_weight=0.1,
    correlation_steps=1,
)


def scene(dataset: Dataset, name: str = "front_left") -> Scene:
    return Scene(dataset.frames[0], name, dataset.rig.cameras[name])

"""Settings of a training of the windows' weights, from a YAML file."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from calibgraph.model.config import Seed

Count = Annotated[int, Field(ge=1, le=10**6)]


class WindowSettings(BaseModel):
    """Settings of the training."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    frames: Count = 6
    """Most frames of a recording, spread over it."""
    windows: Count = 1500
    """Most windows of a frame."""
    epochs: Count = 8
    """How often every camera is seen."""
    batch: Count = 4
    """Cameras per step."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 2e-3
    """Peak of the one-cycle schedule."""
    weight_decay: Annotated[float, Field(ge=0, le=10)] = 1e-2
    """Of the optimizer, AdamW."""
    noise: Annotated[float, Field(ge=0, le=10)] = 0.5
    """Standard deviation of noise on the features, in theirs."""
    seed: Seed = 0
    """Seed of everything random."""

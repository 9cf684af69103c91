"""Rigs, written to files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calibgraph import (
    Rig,
)


def written(rig: Rig, folder: Path, **changes: Any) -> Path:
    """A rig file with some keys of its camera `left` changed."""
    content = rig.model_dump()
    content["cameras"]["left"] |= changes
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(_plain(content)))
    return path


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value.tolist() if isinstance(value, np.ndarray) else value

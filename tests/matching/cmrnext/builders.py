"""Checkpoints and clouds that several tests of the learned matcher build."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from calibgraph.matching.cmrnext.architecture import Architecture
from calibgraph.matching.cmrnext.network import CmrNext

CONFIG = {
    "use_reflectance": False,
    "normalize_images": True,
    "max_depth": 160.0,
    "upsample_method": "transposed",
    "fourier_levels": 12,
    "context_encoder": "lidar",
    "uncertainty": False,
    "max_r": 1.0,
    "max_t": 0.1,
}


def good_content(architecture: Architecture | None = None, **config: Any) -> dict[str, Any]:
    """The content of a checkpoint with an untrained network of width 8."""
    torch.manual_seed(0)
    state = CmrNext(architecture or Architecture(width=8)).state_dict()
    return {"config": CONFIG | config, "epoch": 150, "state_dict": state, "train_loss": 0.5}


def saved(path: Path, content: Any) -> Path:
    torch.save(content, path)
    return path

"""Architectures: recognised from shapes, with the published numbers of parameters."""

from __future__ import annotations

import torch

from calibgraph.matching.cmrnext.architecture import Architecture, recognize_architecture
from calibgraph.matching.cmrnext.network import CmrNext


def test_parameters_count_as_published() -> None:
    counts = {
        Architecture(): (211, 6_462_368),
        Architecture(uncertainty="nll"): (211, 6_466_978),
        Architecture(uncertainty="nll_frozen"): (241, 9_583_328),
        Architecture(context="rgb"): (211, 6_393_376),
        Architecture(fourier_levels=-1): (211, 6_311_840),
        Architecture(reflectance=True): (211, 6_468_640),
    }
    for architecture, (entries, parameters) in counts.items():
        with torch.device("meta"):
            model = CmrNext(architecture)
        assert len(model.state_dict()) == entries
        assert sum(p.numel() for p in model.parameters()) == parameters
        shapes = {name: tuple(t.shape) for name, t in model.state_dict().items()}
        assert recognize_architecture(shapes, reflectance=architecture.reflectance) == architecture

"""Training of the windows' weights on the pose that their matches give. Needs torch."""

from calibgraph.errors import needs_extra

with needs_extra("learned", "training needs torch"):
    import torch as _torch  # noqa: F401

from calibgraph.matching.structure.training.settings import WindowSettings
from calibgraph.matching.structure.training.train import train_windows

__all__ = ["WindowSettings", "train_windows"]

"""The learned matcher CMRNext: its network, weights, matcher and training. Needs torch."""

from calibgraph.errors import needs_extra

with needs_extra(
    "learned",
    "the matcher cmrnext needs torch (without a GPU, first pip install torch --index-url "
    "https://download.pytorch.org/whl/cpu)",
):
    import torch as _torch  # noqa: F401

from calibgraph.matching.cmrnext.checkpoint import Checkpoint, load_checkpoint
from calibgraph.matching.cmrnext.matcher import CmrNextMatcher
from calibgraph.matching.cmrnext.training.settings import TrainSettings
from calibgraph.matching.cmrnext.training.train import train
from calibgraph.matching.cmrnext.training.validation import Validation

__all__ = [
    "Checkpoint",
    "CmrNextMatcher",
    "TrainSettings",
    "Validation",
    "load_checkpoint",
    "train",
]

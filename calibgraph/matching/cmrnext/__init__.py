"""The learned matcher CMRNext: its network, weights, matcher and training. Needs torch."""

try:
    import torch as _torch  # noqa: F401
except ModuleNotFoundError as error:
    from calibgraph.errors import CalibrationError

    raise CalibrationError(
        "the matcher cmrnext needs torch, which is not installed: pip install 'calibgraph[learned]'"
        " (without a GPU: pip install torch --index-url https://download.pytorch.org/whl/cpu first)"
    ) from error

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

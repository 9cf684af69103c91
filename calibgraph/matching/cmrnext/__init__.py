"""The learned matcher CMRNext: its network, weights and matcher. Needs torch."""

from calibgraph.errors import needs_extra

with needs_extra(
    "learned",
    "the matcher cmrnext needs torch (without a GPU, first pip install torch --index-url "
    "https://download.pytorch.org/whl/cpu)",
):
    import torch as _torch  # noqa: F401

from calibgraph.matching.cmrnext.checkpoint import Checkpoint, load_checkpoint
from calibgraph.matching.cmrnext.matcher import CmrNextMatcher

__all__ = ["Checkpoint", "CmrNextMatcher", "load_checkpoint"]

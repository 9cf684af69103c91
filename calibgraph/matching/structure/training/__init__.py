"""Training of the windows' weights on the pose that their matches give. Needs torch."""

try:
    import torch as _torch  # noqa: F401
except ModuleNotFoundError as error:
    from calibgraph.errors import CalibrationError

    raise CalibrationError(
        "training needs torch, which is not installed: pip install 'calibgraph[learned]'"
    ) from error

from calibgraph.matching.structure.training.settings import (
    WindowSettings,
    load_window_settings,
)
from calibgraph.matching.structure.training.train import train_windows

__all__ = ["WindowSettings", "load_window_settings", "train_windows"]

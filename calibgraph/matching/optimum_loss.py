"""The loss on the pose that the matches of a camera give, in torch."""

from __future__ import annotations

import gtsam
import torch
from torch import Tensor

from calibgraph.arrays import Array
from calibgraph.graph.objective import pose_key
from calibgraph.solver.pose_loss import pose_loss
from factors import ProjectionBlock

_CAMERA = "camera"


def optimum_loss(
    block: ProjectionBlock,
    T_camera_lidar: Array,
    prior: tuple[gtsam.Pose3, Array],
    *,
    pixels_px: Tensor,
    log_weights: Tensor | None = None,
) -> Tensor:
    """The negative log-likelihood of a true pose under the optimum, see ``solver.pose_loss``.

    Args:
        block: the camera's matches.
        T_camera_lidar: (4, 4) the truth.
        prior: T_lidar_camera, and the (6,) sigmas of its twist.
        pixels_px: (n, 2) of the block, differentiable.
        log_weights: (n,) logarithms of the weights in the block, differentiable; None if they
            depend on nothing.

    Returns:
        A number, with its gradient by the pixels and the logarithms of the weights.
    """
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Diagonal.Sigmas(prior[1])
    graph.add(gtsam.PriorFactorPose3(pose_key([_CAMERA], _CAMERA), prior[0], noise))
    found = pose_loss({_CAMERA: block}, graph, {_CAMERA: T_camera_lidar})
    loss = _with_gradient(pixels_px, found.by_pixels[_CAMERA])
    if log_weights is not None:
        loss = loss + _with_gradient(log_weights, found.by_log_weights[_CAMERA])
    return loss + found.value


def _with_gradient(values: Tensor, gradient: Array) -> Tensor:
    """Zero, with this gradient by the values."""
    return ((values - values.detach()) * torch.as_tensor(gradient).to(values)).sum()

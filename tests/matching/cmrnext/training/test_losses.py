"""The loss of the pose: of the true flow none can be likelier, and its gradient leads there."""

from __future__ import annotations

import numpy as np
import torch

from calibgraph import Dataset
from calibgraph.matching.cmrnext.training.losses import optimum_loss
from calibgraph.matching.cmrnext.training.samples import Sample, make_sample
from tests.matching.cmrnext.training.tiny import TINY, scene


def drawn(trusted: Dataset) -> Sample:
    rng = np.random.default_rng(3)
    sample = make_sample(scene(trusted), TINY, rng, augment=True)
    assert sample is not None
    return sample


def image_of(sample: Sample, at_points: torch.Tensor) -> torch.Tensor:
    """(1, 2, H, W) flow with these values at the points."""
    flow = torch.zeros(1, 2, *sample.rgb.shape[1:], dtype=torch.float64)
    flow[0][:, sample.cells[:, 0], sample.cells[:, 1]] = at_points.T.double()
    return flow


def test_the_gradient_leads_to_the_true_pose_and_reaches_the_points_alone(trusted: Dataset) -> None:
    sample = drawn(trusted)
    truth = image_of(sample, sample.flow_px)
    noise = torch.randn(sample.flow_px.shape, generator=torch.Generator().manual_seed(0))
    flow = (truth + image_of(sample, noise)).requires_grad_()
    loss = optimum_loss(flow, [sample], TINY)
    loss.backward()
    assert flow.grad is not None
    at_points = image_of(sample, torch.ones_like(sample.flow_px)) != 0
    assert torch.count_nonzero(flow.grad[~at_points]) == 0
    step = 0.1 / float(flow.grad.abs().max()) * flow.grad
    lower = optimum_loss(flow.detach() - step, [sample], TINY)
    expected = float((step * flow.grad).sum())
    # To second order: of a step of this size, the loss falls by its slope to within a half.
    assert 0.5 * expected < float(loss.detach() - lower) < 1.5 * expected


def test_a_common_error_of_all_pixels_costs_more_than_the_same_noise(trusted: Dataset) -> None:
    """A flow loss cannot tell them apart; the pose of the one is wrong."""
    sample = drawn(trusted)
    common = torch.ones_like(sample.flow_px)
    signs = torch.randint(0, 2, common.shape, generator=torch.Generator().manual_seed(1)) * 2 - 1
    losses = [
        float(optimum_loss(image_of(sample, sample.flow_px + e), [sample], TINY))
        for e in (common, signs.float())
    ]
    assert losses[0] > losses[1]

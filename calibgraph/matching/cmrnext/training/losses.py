"""The losses of training, at the points of a batch of samples."""

import math
from collections.abc import Iterable, Sequence

import gtsam
import numpy as np
import torch
from torch import Tensor

from calibgraph.matching.cmrnext.correlation import WINDOW, Correlation, cross_entropy
from calibgraph.matching.cmrnext.layers import CELL
from calibgraph.matching.cmrnext.network import upscale
from calibgraph.matching.cmrnext.training.samples import Sample
from calibgraph.matching.cmrnext.training.settings import TrainSettings
from calibgraph.matching.optimum_loss import optimum_loss as pose_optimum_loss
from factors import ProjectionBlock, pose_sigmas

_DISCOUNT = 0.8  # of each iteration's loss against the next one's
_USUAL, _LEAST_PX = 1.5, 1.0  # scale of the robust loss: in median errors, and at least
_OFFSET_CELLS = 3.5  # largest distance of the correlation loss's windows from the truth, per axis


def flow_loss(
    flows: Iterable[Tensor], samples: Sequence[Sample], *, iterations: int, halved: bool
) -> Tensor:
    """The published loss: every iteration's absolute error at the points, over all pixels.

    Args:
        flows: (B, 2, H, W) flow after every iteration [px].
        samples: of the batch.
        iterations: number of flows.
        halved: whether the network's images have half the size.
    """
    pixels = sum(sample.size[0] * sample.size[1] for sample in samples)
    loss = torch.zeros(())
    for iteration, flow in enumerate(flows, start=1):
        truth = true_flow(samples, flow.device)
        error = (flow_at_points(flow, samples, halved=halved) - truth).abs().sum()
        loss = loss.to(error) + _DISCOUNT ** (iterations - iteration) * error / (2 * pixels)
    return loss


def correlation_loss(
    correlation: Correlation, samples: Sequence[Sample], *, seed: int, halved: bool
) -> Tensor:
    """Cross-entropy of each LiDAR cell's correlation window at the true position of its points.

    The windows' centres are drawn at random around the truth, so that each contains its target and
    the targets are spread over the windows.
    """
    height, width = (size // CELL for size in samples[0].rgb.shape[1:])
    truth, known = _true_cells(samples, height, width, CELL * (1 + halved))
    generator = torch.Generator().manual_seed(seed)
    offsets = _OFFSET_CELLS * (2 * torch.rand(len(truth), 2, generator=generator) - 1)
    centres = (truth + offsets).view(len(samples), height, width, 2).permute(0, 3, 1, 2)
    windows = correlation.window(centres.to(correlation.device))[:, : WINDOW**2]
    rows = windows.permute(0, 2, 3, 1).reshape(-1, WINDOW**2)
    return cross_entropy(rows[known.to(rows.device)], -offsets[known].to(rows.device))


def _true_cells(
    samples: Sequence[Sample], height: int, width: int, cell_px: int
) -> tuple[Tensor, Tensor]:
    """(B h w, 2) mean true x, y of each LiDAR cell's points [cells], and the cells with points."""
    count = torch.zeros(len(samples) * height * width, 1)
    total = torch.zeros(len(samples) * height * width, 2)
    for i, sample in enumerate(samples):
        y, x = (sample.cells // cell_px).T
        index = (i * height + y) * width + x
        count.index_add_(0, index, torch.ones(len(index), 1))
        total.index_add_(0, index, torch.stack([x, y], dim=1) + sample.flow_px / cell_px)
    return total / count.clamp(min=1.0), count[:, 0].nonzero()[:, 0]


def flow_at_points(flow: Tensor, samples: Sequence[Sample], *, halved: bool) -> Tensor:
    """(n, 2) flow at the points of all samples, from (B, 2, H, W) [px]."""
    full = upscale(flow, halved=halved)
    cells = [sample.cells.to(flow.device) for sample in samples]
    return torch.cat([full[i, :, c[:, 0], c[:, 1]].T for i, c in enumerate(cells)])


def true_flow(samples: Sequence[Sample], device: torch.device) -> Tensor:
    """(n, 2) true flow at the points of all samples [px]."""
    return torch.cat([sample.flow_px for sample in samples]).to(device)


def optimum_loss(flow: Tensor, samples: Sequence[Sample], settings: TrainSettings) -> Tensor:
    """How unlikely the true poses are under those that minimize the graph of the predicted pixels.

    A graph has the matches of a sample, with the Cauchy loss, and the perturbation's distribution
    as a prior. The gradient is that of its minimum, see ``solver.pose_loss``. Mean over samples.

    Args:
        flow: (B, 2, H, W) after the last iteration [px].
        samples: of the batch.
        settings: of the training.
    """
    losses = [
        _optimum_loss_of(
            flow_at_points(flow[i : i + 1], [sample], halved=settings.half_resolution),
            sample,
            settings,
        )
        for i, sample in enumerate(samples)
    ]
    return torch.stack(losses).mean()


def _optimum_loss_of(flow_px: Tensor, sample: Sample, settings: TrainSettings) -> Tensor:
    """Of (n, 2) flow at the points of one sample; the prior is about the perturbed start."""
    pixels = sample.pixels_px + flow_px.detach().cpu().numpy()
    errors_px = np.linalg.norm(pixels - sample.view.project(sample.points_camera_m), axis=1)
    block = ProjectionBlock(
        sample.view.lens, sample.points_camera_m, pixels,
        scale=max(_USUAL * float(np.median(errors_px)), _LEAST_PX),
    )  # fmt: skip
    sigmas = pose_sigmas(
        rotation_rad=math.radians(settings.rotation_deg), translation_m=settings.translation_m
    )
    prior = gtsam.Pose3(sample.E), sigmas / math.sqrt(3)  # of a uniform distribution
    return pose_optimum_loss(block, np.eye(4), prior, pixels_px=flow_px)

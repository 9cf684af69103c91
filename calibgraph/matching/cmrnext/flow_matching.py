"""Matches of one network: images and clouds in, a table of correspondences per image out.

And the outcome of each image, with the matcher's findings from all of them. The confidence of a
match, 0 to 1, is a product of three factors: convergence, correlation peak, and agreement with the
frame's pose. It ranks matches, but is not calibrated: it is no probability.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.io.frame import Frame
from calibgraph.matching.cmrnext.checkpoint import Checkpoint
from calibgraph.matching.cmrnext.correlation import WINDOW
from calibgraph.matching.cmrnext.inputs import (
    LidarImage,
    View,
    encode_depth,
    halve_lidar,
    lidar_channels,
    lidar_tensor,
    rgb_tensor,
)
from calibgraph.matching.cmrnext.network import CELL, CmrNext, upscale
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.rig import Camera

Maps = NDArray[np.float32]

HALVED_FROM_PX = 1400
"""Images at least this wide are halved unless the user chooses: the networks were trained at 1241
pixels, and on larger images halved."""

STEP_PX = 1.0
"""A last iteration that moves the match by this halves its confidence."""

RESIDUAL_PX = 4.0
"""A reprojection error of this at the frame's pose halves it."""

MIN_CONFIDENCE = 1e-3


@dataclass(frozen=True, eq=False)
class MatchingJob:
    """One camera's image of one frame, with an estimate of its extrinsic.

    Attributes:
        frame: of the dataset.
        name: of the camera.
        camera: with its lens.
        view: the camera without distortion.
        image: (h, w, 3) RGB without distortion.
        cloud: (n, 4) x y z [m] in the LiDAR frame, intensity.
        T_camera_lidar: (4, 4) the estimate.
    """

    frame: Frame
    name: str
    camera: Camera
    view: View
    image: NDArray[np.uint8]
    cloud: NDArray[np.float32]
    T_camera_lidar: Array


def load_job(frame: Frame, name: str, camera: Camera, view: View) -> MatchingJob:
    """Load image and cloud; the estimate is the camera's extrinsic."""
    image = view.undistort(frame.load_image(name, camera))
    return MatchingJob(frame, name, camera, view, image, frame.load_cloud(), camera.T_camera_lidar)


@dataclass(frozen=True, eq=False)
class FlowMatcher:
    """One network of the schedule.

    Attributes:
        checkpoint: its weights and config.
        model: the network, on its device.
        iterations: of the recurrent update.
        half_resolution: whether images are halved; None: from ``HALVED_FROM_PX`` on.
    """

    checkpoint: Checkpoint
    model: CmrNext
    iterations: int
    half_resolution: bool | None

    def match(self, job: MatchingJob) -> Correspondences:
        """Match an image; the table does not depend on a frame's pose."""
        is_wide, given = job.camera.width_px >= HALVED_FROM_PX, self.half_resolution
        halved = is_wide if given is None else given
        lidar = LidarImage.render(job.cloud, job.T_camera_lidar, job.view)
        full, coarse = self._flow(job, lidar, halved)
        return to_table(job, lidar, full, coarse, cell=CELL * (1 + halved))

    def _flow(self, job: MatchingJob, lidar: LidarImage, halved: bool) -> tuple[Maps, Maps]:
        """(2, H, W) flow, (2, h, w) last step and peak."""
        checkpoint, device = self.checkpoint, next(self.model.parameters()).device
        image = job.image[::2, ::2] if halved else job.image
        channels = lidar_channels(lidar, checkpoint.architecture, checkpoint.max_depth_m)
        rgb = rgb_tensor(image, normalize=checkpoint.config["normalize_images"])
        raw = lidar_tensor(halve_lidar(channels) if halved else channels)
        exact: Any = torch.backends.cudnn.flags(  # full float32, the same numbers at every call
            enabled=True, benchmark=False, deterministic=True, allow_tf32=False
        )
        with torch.inference_mode(), exact:
            inputs = encode_depth(raw[None].to(device), checkpoint.architecture)
            flow = self.model(rgb[None].to(device), inputs, iterations=self.iterations)
            full = upscale(flow.flow_px, halved=halved)
            coarse = torch.stack([flow.step_px * (1 + halved), flow.peak], dim=1)
            return full[0].cpu().numpy(), coarse[0].cpu().numpy()


def to_table(
    job: MatchingJob, lidar: LidarImage, full: Maps, coarse: Maps, *, cell: int
) -> Correspondences:
    """Matches of one image: exact sub-pixel projections plus the flow at their pixels.

    Args:
        job: the camera and frame.
        lidar: the points in the network's input.
        full: (2, H, W) flow [px].
        coarse: (2, h, w) last step [px] and correlation peak.
        cell: pixels per coarse cell.
    """
    rows, columns = lidar.cells.T
    values = full[:, rows, columns].T.astype(np.float64)
    pixels, on_image = job.view.distort(lidar.pixels_px + np.nan_to_num(values, nan=1e9))
    kept = on_image & np.isfinite(values).all(axis=1)
    index = lidar.point_index[kept]
    step, peak = coarse[:, rows[kept] // cell, columns[kept] // cell].astype(np.float64)
    converged = 1.0 / (1.0 + (step / STEP_PX) ** 2)
    confidence = converged * peak / (peak + 1.0 / WINDOW**2)  # a peak of chance halves it
    return Correspondences.from_arrays(
        camera=job.name,
        frame=job.frame.index,
        pixels_px=pixels[kept].reshape(-1, 2),
        points_lidar_m=job.cloud[index, :3],
        confidence=_bound(confidence),
    )


def lower_by_residuals(confidence: NDArray[np.float32], residual_px: Array) -> NDArray[np.float32]:
    """Confidence lowered by (n,) reprojection errors at the pose of the frame's own matches."""
    return _bound(confidence / (1.0 + (residual_px / RESIDUAL_PX) ** 2))


def _bound(values: Array | NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.nan_to_num(values).clip(MIN_CONFIDENCE, 1.0), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class ImageResult:
    """The outcome of one image.

    Attributes:
        job: with the estimate from which the last network started.
        matches: of the last network.
        T_camera_lidar: (4, 4) estimated from them by PnP; None if that failed.
        failed: whether a network gave no pose, or one beyond its range of training.
        start_dependence: see :mod:`calibgraph.matching.cmrnext.matcher`; NaN if not measured.
        memorization: see the same module; NaN if not measured.
    """

    job: MatchingJob
    matches: Correspondences
    T_camera_lidar: Array | None
    failed: bool
    start_dependence: float = math.nan
    memorization: float = math.nan


def to_findings(results: Mapping[str, Sequence[ImageResult]]) -> MatcherFindings:
    """Failed frames, the probes, and the error that all matches share."""
    return MatcherFindings(
        failed_share={name: float(np.mean([r.failed for r in e])) for name, e in results.items()},
        start_dependence=_medians(results, "start_dependence"),
        memorization=_medians(results, "memorization"),
        **error_components().matchers["cmrnext"],
    )


def _medians(results: Mapping[str, Sequence[ImageResult]], attribute: str) -> dict[str, float]:
    """Median of a probe over the frames of each camera; NaN if none could be measured."""
    medians = {}
    for name, of_camera in results.items():
        probed = np.array([getattr(result, attribute) for result in of_camera])
        finite = probed[np.isfinite(probed)]
        medians[name] = float(np.median(finite)) if len(finite) else math.nan
    return medians

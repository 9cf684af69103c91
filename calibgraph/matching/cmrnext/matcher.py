"""The matcher `cmrnext` as the pipeline sees it: a schedule of networks, and a table of matches."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray

from calibgraph.io.dataset import Dataset, Frame, spread_out
from calibgraph.matching.cmrnext import confidence, probe
from calibgraph.matching.cmrnext.checkpoint import Checkpoint, load_checkpoint
from calibgraph.matching.cmrnext.inputs import (
    LidarImage,
    View,
    encoded,
    halved_lidar,
    lidar_channels,
    lidar_tensor,
    rgb_tensor,
)
from calibgraph.matching.cmrnext.network import CELL, CmrNext, torch_device
from calibgraph.matching.cmrnext.samples import at_full_resolution
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import angle_deg, relative_transform
from calibgraph.model.rig import Camera, Rig
from calibgraph.solver.pnp import frame_pose

if TYPE_CHECKING:
    from calibgraph.progress import Progress

Array = NDArray[np.float64]

SYSTEMATIC_ROTATION_RAD = float(np.radians(0.06))
SYSTEMATIC_TRANSLATION_M = 0.025
"""Error per axis that all frames share, for networks that do not say: root mean square of what the
authors publish for four data sets, over up to 4541 frames each."""

HALVED_FROM_PX = 1400
"""Images at least this wide are halved unless the weights or the user say otherwise: the networks
were trained at 1241 pixels, and on larger images halved."""

_BATCH = {"cpu": 1, "cuda": 4}
_PROBED_FRAMES = 5  # per camera
_BEYOND = 2.0  # times the range of training, corner to corner: no network corrects by more


@dataclass(frozen=True, eq=False)
class _Network:
    """One network of the schedule."""

    checkpoint: Checkpoint
    model: CmrNext

    def halves(self, camera: Camera, wanted: bool | None) -> bool:
        """Whether it is shown a camera's images at half their size."""
        said = self.checkpoint.config.get("half_resolution")
        if wanted is not None:
            return wanted
        return said if isinstance(said, bool) else camera.width_px >= HALVED_FROM_PX


@dataclass(frozen=True, eq=False)
class _Job:
    """One camera's image of one frame, and where its camera is thought to be."""

    frame: Frame
    name: str
    camera: Camera
    view: View
    image: NDArray[np.uint8]
    cloud: NDArray[np.float32]
    T_camera_lidar: Array


@dataclass(frozen=True, eq=False)
class _Found:
    """What one image gave.

    Attributes:
        job: with the pose that the last network started from.
        matches: of the last network.
        pose: (4, 4) T_camera_lidar from them, or None.
        failed: whether a network gave no pose, or one beyond what it was trained to correct.
        start_dependence: see :mod:`calibgraph.cmrnext.probe`; None if it was not measured.
        recall: the same.
    """

    job: _Job
    matches: Correspondences
    pose: Array | None
    failed: bool
    start_dependence: float | None = None
    recall: float | None = None


class CmrNextMatcher:
    """Matching by CMRNext networks, from coarse to fine.

    Args:
        weights: files of weights, in the order in which the networks are run; a file may come
            more than once.
        estimate: where a network gets its poses from. ``frame``: from the matches of the network
            before in the same image, by PnP, as the original; frames that fail are left out.
            ``joint``: from the joint solve over all frames and cameras.
        device: ``cpu``, ``cuda``, or ``auto``.
        iterations: of the recurrent update.
        half_resolution: whether images are halved; None: as the weights say, or from 1400 pixels.
        occlusion_filter: leave out points that are seen through something nearer.
        batch: images at once; None: 1 on a CPU, 4 on a GPU.
        seed: of PnP.

    Raises:
        FileError: if a file is missing, damaged, or not of a CMRNext network.
        ValueError: on a wrong argument.
    """

    stage1: Literal["pnp", "rig"] = "pnp"

    def __init__(
        self,
        weights: Sequence[Path | str],
        *,
        estimate: Literal["frame", "joint"] = "frame",
        device: str = "auto",
        iterations: int = 12,
        half_resolution: bool | None = None,
        occlusion_filter: bool = False,
        batch: int | None = None,
        seed: int = 0,
    ) -> None:
        if not weights:
            raise ValueError("no weights given: --weights iter1.tar iter5.tar iter6.tar")
        if estimate not in ("frame", "joint"):
            raise ValueError(f"estimate {estimate!r}: known are frame, joint")
        if iterations < 1 or (batch is not None and batch < 1):
            raise ValueError(f"iterations {iterations}, batch {batch}: expected at least 1")
        self.device = torch_device(device)
        loaded = {str(path): self._load(path) for path in dict.fromkeys(map(str, weights))}
        self.networks = [loaded[str(path)] for path in weights]
        self.estimate = estimate
        self.iterations = iterations
        self.half_resolution = half_resolution
        self.occlusion_filter = occlusion_filter
        self.batch = batch or _BATCH[self.device.type]
        self.seed = seed
        self.rounds = len(self.networks) if estimate == "joint" else 1

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Match every camera in every frame, from the rig's poses."""
        schedule = self.networks
        if self.estimate == "joint":
            schedule = schedule[round_index : round_index + 1]
        total = len(rig.cameras) * len(dataset.frames)
        found: dict[str, list[_Found]] = {name: [] for name in rig.cameras}
        probed = {frame.index for frame in spread_out(dataset.frames, _PROBED_FRAMES)}
        done = 0
        for jobs in self._batches(dataset, rig):
            what = f"round {round_index + 1} of {self.rounds}: {jobs[0].frame.name}"
            progress(what, round_index * total + done, self.rounds * total)
            results = self._chain(jobs, schedule)
            if round_index == self.rounds - 1:
                results = [self._probed(each, schedule[-1]) if each.job.frame.index in probed
                           else each for each in results]  # fmt: skip
            for each in results:
                found[each.job.name].append(each)
            done += len(jobs)
        tables = [each.matches for all_ in found.values() for each in _not_failed(all_)]
        metadata = self._metadata(schedule, round_index) | _findings(found)
        return replace(concatenate(tables), metadata=metadata)

    def _chain(self, jobs: list[_Job], schedule: Sequence[_Network]) -> list[_Found]:
        """Run the networks on a batch, each from the poses that the one before leads to."""
        failed = [False] * len(jobs)
        for network in schedule:
            results = []
            for i, (job, table) in enumerate(zip(jobs, self._matches(network, jobs), strict=True)):
                pose = frame_pose(job.camera, table, Config(seed=self.seed))
                good = pose is not None and _within_range(network.checkpoint, job, pose)
                failed[i] |= not good
                results.append(_Found(job, _consistent(job, table, pose), pose, failed[i]))
            jobs = [
                each.job
                if each.failed or each.pose is None
                else replace(each.job, T_camera_lidar=each.pose)
                for each in results
            ]
        return results

    def _probed(self, found: _Found, network: _Network) -> _Found:
        """Match again from a displaced start: with the image, and with a blank one."""
        job = found.job
        base = job.T_camera_lidar if found.pose is None else found.pose
        rng = np.random.default_rng([self.seed, job.frame.index])
        T = probe.displaced(base, network.checkpoint.range_deg_m, rng)
        blank = np.full_like(job.image, probe.BLANK)
        again, without = (
            self._matches(network, [replace(job, T_camera_lidar=T, image=image)])[0]
            for image in (job.image, blank)
        )
        dependence, kept = (
            probe.remaining_share(job.camera, base, T, table) for table in (again, without)
        )
        return replace(found, start_dependence=dependence, recall=1.0 - kept)

    def _matches(self, network: _Network, jobs: list[_Job]) -> list[Correspondences]:
        """One network's matches of each job, without confidence unless it predicts it."""
        halved = network.halves(jobs[0].camera, self.half_resolution)
        checkpoint = network.checkpoint
        seen, rgbs, lidars = [], [], []
        for job in jobs:
            lidar = LidarImage.of(job.cloud, job.T_camera_lidar, job.view)
            lidar = lidar.without_occluded() if self.occlusion_filter else lidar
            channels = lidar_channels(lidar, checkpoint.variant, checkpoint.max_depth_m)
            image = job.image[::2, ::2] if halved else job.image
            seen.append(lidar)
            rgbs.append(rgb_tensor(image, normalize=checkpoint.config["normalize_images"]))
            lidars.append(lidar_tensor(halved_lidar(channels) if halved else channels))
        with torch.inference_mode(), _exact():
            rgb, raw = torch.stack(rgbs).to(self.device), torch.stack(lidars).to(self.device)
            inputs = encoded(raw, checkpoint.variant)
            flow = network.model(rgb, inputs, iterations=self.iterations)
            maps = [at_full_resolution(flow.flow_px, halved=halved)]
            if flow.sigma_px is not None:
                maps.append(at_full_resolution(flow.sigma_px, halved=halved, is_flow=False))
            full = torch.cat(maps, dim=1).cpu().numpy()
            coarse = torch.stack([flow.step_px * (1 + halved), flow.peak], dim=1).cpu().numpy()
        cell = CELL * (1 + halved)
        return [
            _table(job, lidar, full[i], coarse[i], cell)
            for i, (job, lidar) in enumerate(zip(jobs, seen, strict=True))
        ]

    def _batches(self, dataset: Dataset, rig: Rig) -> Iterator[list[_Job]]:
        """Jobs of equal image size, frame by frame, loaded when they are asked for."""
        views = {name: View(camera, crop_even=True) for name, camera in rig.cameras.items()}

        def size(name: str) -> tuple[int, int]:
            return views[name].height, views[name].width

        for _, group in groupby(sorted(rig.cameras, key=size), key=size):
            names = list(group)
            pairs = [(frame, name) for frame in dataset.frames for name in names]
            for start in range(0, len(pairs), self.batch):
                yield [_job(frame, name, rig.cameras[name], views[name])
                       for frame, name in pairs[start : start + self.batch]]  # fmt: skip

    def _load(self, path: str) -> _Network:
        checkpoint = load_checkpoint(path)
        return _Network(checkpoint, checkpoint.network(self.device))

    def _metadata(self, schedule: Sequence[_Network], round_index: int) -> dict[str, Any]:
        last = schedule[-1].checkpoint
        default = {
            "systematic_rotation_rad": SYSTEMATIC_ROTATION_RAD,
            "systematic_translation_m": SYSTEMATIC_TRANSLATION_M,
        }
        return {
            "matcher": "cmrnext",
            "round": round_index,
            "schedule": [
                {"file": n.checkpoint.path.name, "sha256": n.checkpoint.sha256,
                 "range_deg_m": n.checkpoint.range_deg_m}
                for n in self.networks
            ],
            "estimate": self.estimate,
            "iterations": self.iterations,
            "half_resolution": self.half_resolution,
            "occlusion_filter": self.occlusion_filter,
            "device": self.device.type,
            "seed": self.seed,
            "confidence": "uncalibrated" if last.variant.uncertainty == "none" else "predicted",
            **{key: last.config.get(key, value) for key, value in default.items()},
        }  # fmt: skip


def _exact() -> AbstractContextManager[None]:
    """A GPU in full float32, and the same numbers at every call."""
    flags = torch.backends.cudnn.flags(
        enabled=True, benchmark=False, deterministic=True, allow_tf32=False
    )
    return cast(AbstractContextManager[None], flags)


def _job(frame: Frame, name: str, camera: Camera, view: View) -> _Job:
    image = view.image(frame.load_image(name, camera))
    return _Job(frame, name, camera, view, image, frame.load_cloud(), camera.T_camera_lidar)


def _findings(found: Mapping[str, Sequence[_Found]]) -> dict[str, Any]:
    """What the verdict heeds, per camera: failed frames, and in the last round the probes."""
    failed = {name: [each.job.frame.name for each in all_ if each.failed]
              for name, all_ in found.items()}  # fmt: skip
    findings: dict[str, Any] = {
        "failed_frames": failed,
        "failed_share": {name: len(failed[name]) / len(all_) for name, all_ in found.items()},
    }
    for key in ("start_dependence", "recall"):
        values = {name: [getattr(each, key) for each in all_] for name, all_ in found.items()}
        measured = {name: [v for v in all_ if v is not None] for name, all_ in values.items()}
        findings[key] = {name: _finite_median(all_) for name, all_ in measured.items() if all_}
    return findings


def _finite_median(values: Sequence[float]) -> float:
    """Median of those that could be measured; NaN if none could."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.median(finite)) if finite else float("nan")


def _not_failed(found: list[_Found]) -> list[_Found]:
    """Without the frames that failed; if all did, all, so that the solve can see and say so."""
    return [each for each in found if not each.failed] or found


def _within_range(checkpoint: Checkpoint, job: _Job, T_camera_lidar: Array) -> bool:
    """Whether a correction is one that the network can have been trained for."""
    if checkpoint.range_deg_m is None:
        return True
    delta = relative_transform(T_camera_lidar, job.T_camera_lidar)
    most_deg, most_m = (_BEYOND * np.sqrt(3.0) * most for most in checkpoint.range_deg_m)
    length = float(np.linalg.norm(delta[:3, 3]))
    return bool(angle_deg(delta[:3, :3]) <= most_deg and length <= most_m)


def _consistent(job: _Job, table: Correspondences, pose: Array | None) -> Correspondences:
    """The matches, their confidence lowered by what they miss the frame's own pose by."""
    if pose is None or table.information_px is not None:
        return table
    points = table.points_lidar_m @ pose[:3, :3].T + pose[:3, 3]
    projected, valid = job.camera.lens.project(points)
    errors = np.linalg.norm(projected - table.pixels_px, axis=1)
    errors = np.where(valid, errors, np.inf)
    return replace(table, confidence=confidence.with_consistency(table.confidence, errors))


def _table(
    job: _Job, seen: LidarImage, full: NDArray[np.float32], coarse: NDArray[np.float32], cell: int
) -> Correspondences:
    """Matches of one image: exact sub-pixel projections plus the flow at their pixel.

    Args:
        job: the camera and frame.
        seen: the points that were shown.
        full: (2 or 4, H, W) flow, and its standard deviations if there are any [px].
        coarse: (2, h, w) last step [px] and correlation peak.
        cell: pixels per coarse cell.
    """
    rows, columns = seen.cells.T
    found = full[:, rows, columns].T.astype(np.float64)
    pixels, on_image = job.view.recorded(seen.pixels_px + np.nan_to_num(found[:, :2], nan=1e9))
    kept = on_image & np.isfinite(found).all(axis=1)
    index = seen.point_index[kept]
    step, peak = coarse[:, rows[kept] // cell, columns[kept] // cell].astype(np.float64)
    sigma = found[kept, 2:] if found.shape[1] > 2 else None  # noqa: PLR2004 - flow and sigmas
    return Correspondences.from_arrays(
        camera=job.name,
        frame=job.frame.index,
        pixels_px=pixels[kept].reshape(-1, 2),
        points_lidar_m=job.cloud[index, :3],
        confidence=confidence.from_signs(step, peak)
        if sigma is None
        else confidence.from_sigmas(sigma),
        information_px=None if sigma is None else confidence.information(sigma),
        point_index=index,
    )

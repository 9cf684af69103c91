"""Where frames are gated and moves are found: the live epochs as an iSAM2 problem.

It takes all matches for independent (Eq. 5 of the paper), so that each frame is one step. What is
reported is the optimum of the error model, see ``calibgraph.tracking.closed_places``; with a
preset of the paper it is the optimum of this graph.

A camera with a random walk has a variable per epoch:

    summary - x(c, 0) - walk - x(c, 1) - walk - ... - x(c, last) - priors, relative poses
                |                |                      |
              block            block             block, block of the frames added

A static camera has a single variable for all of its blocks.

Older epochs are in the summary, a quadratic about a reference. Priors and relative poses, which are
independent of correspondences, are added once, at the last epoch.
"""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np

from calibgraph.graph.objective import join, objective_graph, pose_key
from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.model.rig import RelativePose
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.tracking.epoch_summary import STRENGTHS
from calibgraph.tracking.live_frames import LiveFrame, inliers_of
from calibgraph.tracking.state import State
from factors import ProjectionBlock, block_factor

_RELINEARIZE = 2e-6  # rad and m: far below any sigma; every epoch begins linearized anew


class Window:
    """iSAM2 over the live epochs of a state, until the next epoch begins."""

    def __init__(self, state: State) -> None:
        self._names = state.names
        self._walks = [camera.summary.walk > 0 for camera in state.cameras]
        self._cameras = len(state.names)
        self._epochs = len(state.epochs)
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(_RELINEARIZE)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._isam = gtsam.ISAM2(parameters)
        values = gtsam.Values()
        for place, epoch in enumerate(state.epochs):
            for camera, T_lidar_camera in enumerate(epoch.T_lidar_camera):
                if self._walks[camera] or epoch is state.epochs[-1]:
                    values.insert(self._key(place, camera), T_lidar_camera)
        graph = join(self._summary_graph(state), self._walk_graph(state), pose_priors(state))
        for camera, camera_state in enumerate(state.cameras):
            for key, inliers in self._by_key(state, camera).items():
                graph.add(block_factor(key, inliers.with_scale(camera_state.scale)))
        self._isam.update(graph, values)
        self._added: dict[int, ProjectionBlock] = {}
        self._places: dict[int, int] = {}
        self._tried: tuple[int, ...] = ()

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Its factors."""
        held, graph = self._isam.getFactorsUnsafe(), gtsam.NonlinearFactorGraph()
        for index in range(held.size()):
            if held.exists(index):  # others were removed
                graph.push_back(held.at(index))
        return graph

    def fit(self, blocks: Mapping[int, ProjectionBlock]) -> None:
        """The first pass of a frame: one step with its blocks."""
        self._tried = tuple(blocks)
        self._exchange({c: self._with_earlier(c, block) for c, block in blocks.items()})

    def refit(self, blocks: Mapping[int, ProjectionBlock]) -> None:
        """The second pass: one step with these blocks in the place of those of the first."""
        self._added |= {c: self._with_earlier(c, block) for c, block in blocks.items()}
        self._exchange({camera: self._added.get(camera) for camera in self._tried})

    def _with_earlier(self, camera: int, block: ProjectionBlock) -> ProjectionBlock:
        """A block under those of the frames that were added before."""
        earlier = self._added.get(camera)
        return block if earlier is None else ProjectionBlock.join([earlier, block])

    def _exchange(self, blocks: Mapping[int, ProjectionBlock | None]) -> None:
        """One step with other blocks of the added frames: one factor per camera holds them all."""
        removed = [self._places.pop(camera) for camera in blocks if camera in self._places]
        graph, added = gtsam.NonlinearFactorGraph(), []
        for camera, block in blocks.items():
            if block is not None:
                graph.add(block_factor(self._key_of_last(camera), block))
                added.append(camera)
        result = self._isam.update(graph, gtsam.Values(), removed)
        self._places.update(zip(added, result.getNewFactorsIndices(), strict=True))

    def T_lidar_camera(self, camera: int) -> gtsam.Pose3:
        """The estimate of a camera in the last epoch."""
        return self._isam.calculateEstimatePose3(self._key_of_last(camera))

    def T_lidar_camera_by_epoch(self) -> list[tuple[gtsam.Pose3, ...]]:
        """The estimates, per live epoch and camera."""
        values = self._isam.calculateBestEstimate()
        return [
            tuple(values.atPose3(self._key(place, camera)) for camera in range(self._cameras))
            for place in range(self._epochs)
        ]

    def _key(self, place: int, camera: int) -> int:
        """The last epoch's keys are those of a batch: so its graphs can be added unchanged."""
        ago = self._epochs - 1 - place if self._walks[camera] else 0
        return pose_key(self._names, self._names[camera]) + ago * self._cameras

    def _key_of_last(self, camera: int) -> int:
        return self._key(self._epochs - 1, camera)

    def _by_key(self, state: State, camera: int) -> dict[int, CameraBlock]:
        """A camera's inliers of all frames, by the key of their variable."""
        seen: dict[int, list[LiveFrame]] = {}
        for place, epoch in enumerate(state.epochs):
            for frame in epoch.frames:
                if camera in frame.raw:
                    seen.setdefault(self._key(place, camera), []).append(frame)
        return {
            key: block
            for key, frames in seen.items()
            if (block := inliers_of(frames, camera)) is not None
        }

    def _summary_graph(self, state: State) -> gtsam.NonlinearFactorGraph:
        """The summaries of older epochs as factors on the first live one."""
        graph = gtsam.NonlinearFactorGraph()
        for camera, camera_state in enumerate(state.cameras):
            sums = camera_state.summary.selected
            if sums.hessian.any():
                key = self._key(0, camera)
                reference = gtsam.Values()
                reference.insert(key, state.references[camera])
                factor = gtsam.HessianFactor(key, sums.hessian, -sums.gradient, 0.0)
                graph.add(gtsam.LinearContainerFactor(factor, reference))
        return graph

    def _walk_graph(self, state: State) -> gtsam.NonlinearFactorGraph:
        """The random walk from epoch to epoch, with each camera's own strength."""
        graph = gtsam.NonlinearFactorGraph()
        for camera, camera_state in enumerate(state.cameras):
            if not self._walks[camera]:
                continue
            strength = STRENGTHS[camera_state.summary.walk] / np.sqrt(state.overconfidence(camera))
            for place in range(self._epochs - 1):
                variance = state.walk_variance(len(state.epochs[place].frames))
                noise = gtsam.noiseModel.Diagonal.Sigmas(strength * np.sqrt(variance))
                graph.add(
                    gtsam.BetweenFactorPose3(
                        self._key(place, camera),
                        self._key(place + 1, camera),
                        gtsam.Pose3(),
                        noise,
                    )
                )
        return graph


def kept_pairs(state: State) -> tuple[RelativePose, ...]:
    """The relative poses that no move has invalidated."""
    pairs = enumerate(state.rig.relative_poses)
    return tuple(pair for place, pair in pairs if place not in state.dropped_pairs)


def pose_priors(state: State) -> gtsam.NonlinearFactorGraph:
    """Priors about the references, and the relative poses that no move has invalidated."""
    rig = state.rig.model_copy(update={"relative_poses": kept_pairs(state)})
    T_hat = {
        name: to_T_camera_lidar(reference)
        for name, reference in zip(state.names, state.references, strict=True)
    }
    return objective_graph(rig, {}, T_hat, state.config, terms="full")

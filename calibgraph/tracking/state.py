"""The state of the tracker, whole and immutable: a restart needs nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import chain
from operator import add
from typing import TypeVar

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.config import Config
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_rows, to_T_lidar_camera
from calibgraph.model.rig import Rig
from calibgraph.solver.columns import DistortionEvidence
from calibgraph.solver.variance_components import VarianceRatios
from calibgraph.tracking.camera_state import CameraState
from calibgraph.tracking.events import Event
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.live_frames import NO_DISTORTION, Epoch, LiveFrame
from calibgraph.tracking.noise import inflation, widening
from calibgraph.tracking.optimum import Optimum
from calibgraph.tracking.place_sums import PlaceSums
from calibgraph.tracking.sums import Sums

Item = TypeVar("Item")

LEAST_FRAMES = 15  # for the scatter of a six-vector
HISTORY = 50  # frames over which the residuals' size and the share of inliers are taken
_MOST_MOVES = 100  # that are kept


@dataclass(frozen=True, eq=False)
class DriftWatch:
    """A drift that has been detected, but whose cause is not clear yet.

    Attributes:
        camera: that showed it first.
        begun: number of updates at its detection.
        frame: number of the frame since which it drifts.
        anchors: (n,) static sums of older epochs at the time.
    """

    camera: int
    begun: int
    frame: int
    anchors: Sums


@dataclass(frozen=True, eq=False)
class State:
    """The whole state of the tracker.

    Attributes:
        rig: the initial guess.
        config: settings.
        cameras: per camera of the rig.
        references: per camera, T_lidar_camera about which sums are taken.
        epochs: the live ones; the last is open.
        total: sum over all absorbed frames, slowly forgotten: (6 n, 6 n) scatter.
        total_hessian: (n, 6, 6) and of Hessians.
        total_frames: (n,) and of frames.
        dropped_pairs: places in ``rig.relative_poses`` of pairs that a move has invalidated.
        drift: whose cause is not clear yet, or None.
        places: sums of the older frames, place by place, of cameras that do not drift.
        distortion: per camera, of its matches in older epochs in the scan distortion.
        findings: of the errors that frames share, by their matcher.
        sizes: of these, as the data show them, over what the matcher states.
        optimum: of the graph of the closed epochs; None where it is not known.
        frame: number of the last frame, or None.
        stamp_ns: its time, or None.
        updates: number of updates.
        moves: the last events of moves and drifts.
    """

    rig: Rig
    config: Config
    cameras: tuple[CameraState, ...]
    references: tuple[gtsam.Pose3, ...]
    epochs: tuple[Epoch, ...]
    total: Array
    total_hessian: Array
    total_frames: Array
    places: PlaceSums
    distortion: tuple[DistortionEvidence, ...]
    dropped_pairs: tuple[int, ...] = ()
    drift: DriftWatch | None = None
    findings: MatcherFindings = MatcherFindings()
    sizes: VarianceRatios = VarianceRatios()
    optimum: Optimum | None = None
    frame: int | None = None
    stamp_ns: int | None = None
    updates: int = 0
    moves: tuple[Event, ...] = ()

    @staticmethod
    def initial(rig: Rig, config: Config) -> State:
        """Before the first frame.

        Raises:
            ValueError: if a lens or clock is to be estimated.
        """
        require_poses_alone(config)
        n = len(rig.cameras)
        guess = tuple(to_T_lidar_camera(T) for T in rig.T_camera_lidar.values())
        return State(
            rig=rig,
            config=config,
            cameras=tuple(CameraState() for _ in range(n)),
            references=guess,
            epochs=(Epoch.empty(guess),),
            total=np.zeros((6 * n, 6 * n)),
            total_hessian=np.zeros((n, 6, 6)),
            total_frames=np.zeros(n),
            places=PlaceSums.empty(n),
            distortion=(NO_DISTORTION,) * n,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(self.rig.cameras)

    @property
    def T_lidar_camera(self) -> tuple[gtsam.Pose3, ...]:
        """Per camera, the present estimate."""
        return self.epochs[-1].T_lidar_camera

    @property
    def live_frames(self) -> tuple[LiveFrame, ...]:
        """The frames of all live epochs."""
        return tuple(chain.from_iterable(epoch.frames for epoch in self.epochs))

    @property
    def knows_motion(self) -> bool | None:
        """Whether that of the frames whose matches are kept is known; None if there are none."""
        for one in self.cameras:
            for table in one.waiting:
                if len(table):
                    return table.twist_per_s is not None
        absorbed = (raw for frame in self.live_frames for raw in frame.raw.values())
        set_aside = (frame.raw for one in self.cameras for frame in one.outlier_frames)
        kept = next(chain(absorbed, set_aside), None)
        return None if kept is None else kept.block.motion is not None

    @property
    def all_distortion(self) -> tuple[DistortionEvidence, ...]:
        """Per camera, of its matches in all epochs in the scan distortion."""
        every = zip(self.distortion, *(epoch.distortion for epoch in self.epochs), strict=True)
        return tuple(reduce(add, parts) for parts in every)

    @property
    def drifting(self) -> list[int]:
        """The cameras that are followed by a random walk, by their places in the rig."""
        return [camera for camera, one in enumerate(self.cameras) if one.summary.walk]

    def pose_at(self, place: str, camera: int) -> gtsam.Pose3 | None:
        """Of a place at the optimum; None if it is not known, a camera drifts, or was not there."""
        if self.optimum is None or self.cameras[camera].summary.walk:
            return None
        return self.optimum.pose_at(place, camera)

    def at_poses(self, T_lidar_camera: tuple[gtsam.Pose3, ...]) -> State:
        """The state with other estimates in its open epoch."""
        last = changed(self.epochs[-1], T_lidar_camera=T_lidar_camera)
        return changed(self, epochs=(*self.epochs[:-1], last))

    def with_camera(self, index: int, camera: CameraState) -> State:
        """The state with one camera replaced."""
        return changed(self, cameras=replace_item(self.cameras, index, camera))

    def with_moves(self, events: Sequence[Event]) -> State:
        """The state with further moves."""
        return changed(self, moves=(*self.moves, *events)[-_MOST_MOVES:])

    def walk_variance(self, strengths: Array, frames: int) -> Array:
        """(w, 6) variance of walks of (w,) strengths, in units of the configured one."""
        tracking = self.config.tracking
        rotation = np.radians(tracking.walk_rotation_deg) ** 2
        whole = np.repeat([rotation, tracking.walk_translation_m**2], 3) * frames
        return np.outer(strengths**2, whole)

    def frame_noise(self, index: int) -> Array | None:
        """(6, 6) scatter of one frame's gradient of a camera; None while it is unknown.

        That of the frames alone, times the inflation.
        """
        noise = self.scatter_of_frames(index)
        return None if noise is None else noise * self.inflation(index)

    def inflation(self, index: int) -> float:
        """Ratio of the scatter of a camera's epochs to that of their frames, at least 1."""
        return inflation(self.cameras[index].groups)

    def widen(self, index: int, scatter: Array) -> Array:
        """(6, 6) scatter of a camera's gradients, widened by the scatter of groups."""
        noise = self.scatter_of_frames(index)
        if noise is None:
            return scatter
        by = widening(self.cameras[index].groups, noise)
        return np.asarray(by @ scatter @ by.T)

    def scatter_of_frames(self, index: int) -> Array | None:
        """(6, 6) scatter of one frame's gradient, by frames alone; None while it is unknown."""
        frames = self.total_frames[index]
        if frames < LEAST_FRAMES:
            return None
        rows = pose_rows(index)
        return np.asarray(self.total[rows, rows] / (frames - 1))

    def overconfidence(self, index: int) -> float:
        """Mean ratio of a camera's Hessian to its information, at least 1."""
        frames = self.total_frames[index]
        if frames < LEAST_FRAMES:
            return 1.0
        rows = pose_rows(index)
        share = np.linalg.solve(self.total_hessian[index], self.total[rows, rows])
        return max(1.0, float(np.trace(share)) / 6)

    @property
    def all_overconfidence(self) -> Array:
        """(n,) of all cameras."""
        return np.array([self.overconfidence(camera) for camera in range(len(self.cameras))])


def require_poses_alone(config: Config) -> None:
    """Refuse settings that a tracker cannot follow.

    Raises:
        ValueError: if a lens or clock is to be estimated.
    """
    if config.estimate:
        raise ValueError(
            f"while driving, lens and clock are not estimated; found {', '.join(config.estimate)}: "
            "estimate them with `calibgraph solve`, whose result is a rig to track from"
        )


def block_diagonal(blocks: Array) -> Array:
    """(6 n, 6 n) from (n, 6, 6)."""
    n = len(blocks)
    matrix = np.zeros((n, 6, n, 6))
    matrix[np.arange(n), :, np.arange(n)] = blocks
    return matrix.reshape(6 * n, 6 * n)


def replace_item(items: tuple[Item, ...], index: int, item: Item) -> tuple[Item, ...]:
    """The tuple with one item replaced."""
    return (*items[:index], item, *items[index + 1 :])

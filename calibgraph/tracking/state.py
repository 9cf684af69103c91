"""The state of the tracker: a few arrays, whole; a restart needs nothing else.

``n`` is the number of cameras, ``R`` that of the frames whose matches are kept, ``E`` that of the
epochs they are of. An array of a state is never written to: an update works on a shallow copy
of the state, whose arrays it replaces, and what fails leaves the state before it as it was.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array, Mask
from calibgraph.graph.components import VarianceRatios
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.rig import Rig
from calibgraph.solver.robust import ResidualScale
from calibgraph.tracking.cause import inflation
from calibgraph.tracking.events import Event
from calibgraph.tracking.gate import Gated
from calibgraph.tracking.sums import Numbers, PlaceSums, Sums, diagonal_blocks

Item = TypeVar("Item")

LEAST_FRAMES = 15  # for the scatter of a six-vector
HISTORY = 50  # frames that a camera may start from
STRENGTHS = np.array([0.0, 0.2, 1.0, 5.0])
"""The walks of a camera, in units of the configured one; the first is static."""
COUNTS = "given", "used", "left_out", "failed", "absorbed", "repeated"
"""What is counted of each camera: correspondences given and used; frames left out, of these those
whose matching failed, absorbed, and in a row that repeat the one before them."""
BEND = 66
"""Numbers of a camera's matches in the scan distortion: (6, 6) Hessian, (6, 3) the same times the
displacement by a unit of each, (3, 3) information and (3,) vector of the residuals."""
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

    def about(self, steps: Array) -> DriftWatch:
        """With the sums about references that are moved by (n, 6) tangent steps."""
        return replace(self, anchors=self.anchors.shift_reference(steps))


@dataclass(eq=False)
class State:
    """The whole state of the tracker.

    Attributes:
        rig: the initial guess.
        config: settings.
        references: (n, 4, 4) T_camera_lidar about which sums are taken, and at which the frames of
            an epoch are gated: the minimum of Eq. 5 at its begin.
        numbers: (R,) of the frames.
        at: (R,) names of their places; empty: not known.
        sizes: (E,) frames of each epoch; the last is open.
        sums: (R, n) of their inliers.
        matches: per camera, those that were absorbed, in order; of a drifting one, each epoch is
            gated at an estimate of its own.
        places: sums of the older frames, place by place, of cameras that do not drift.
        settled: names of the places whose optimum is known, as of the begin of the epoch.
        steps: (P, n, 6) from the references to where matches at these show the cameras.
        weights: (P, 1 + n) of the cloud and the cameras there in the robust loss.
        shared: (n, 6) from the references to where matches show the cameras at all places.
        bends: (n, 66) of the matches of closed epochs in the scan distortion.
        walks: (n, 4) sums of older epochs, each discounted by its walk.
        evidence: (n, 4) log-likelihoods of the epochs, forgotten slowly.
        walk: (n,) which of the walks is selected.
        groups: (n, 2) number of epochs, and how much these scatter.
        lens: (6, 6 + k) per camera, of closed epochs, by ``calibgraph.solver.lens.lens_columns``.
        lens_errors: (n, 6, 6) covariance of its pose by what may err of its lens.
        travel: (n, 6, 3) of its pose by an unknown motion, by ``solver.lens.error_by_travel``.
        curvature: (n, 6, 6) M of :meth:`calibgraph.tracking.gate.Gated.curvature`.
        total: sum over all absorbed frames, slowly forgotten: (6 n, 6 n) scatter.
        total_hessian: (n, 6, 6) and of Hessians.
        total_frames: (n,) and of frames.
        started: (n,) whether a camera has an estimate of its own.
        scales: of each camera's residuals.
        share: (n,) of a frame's matches that is usually within the gate.
        absent: (n,) frames since the last usable one.
        moved_at: (n,) number of updates when a camera last moved, or -1.
        drift_reported_at: (n,) number of updates when its drift was last reported, or -1.
        counts: (n, 6) see COUNTS.
        waiting: per camera, before it has started, the frames it may start from.
        refused: why it has not started from them.
        outliers: its last frames that disagree with the estimate, each at another that it fits.
        agreements: of its last frames, the number, and whether it agreed.
        dropped_pairs: places in ``rig.relative_poses`` of pairs that a move has invalidated.
        contradicting: of those that contradict the correspondences, and take no part.
        drift: whose cause is not clear yet, or None.
        findings: of the errors that frames share, by their matcher.
        ratios: of these, as the data show them, over what the matcher states.
        stamp_ns: time of the last frame, or None.
        updates: number of updates.
        moves: the last events of moves and drifts.
        motion: the column of frames with the motion of the LiDAR, ``twist_per_s``, or with times of
            points, ``late_s``; empty if they have neither, None before the first.
    """

    rig: Rig
    config: Config
    references: Array
    numbers: Numbers
    at: tuple[str, ...]
    sizes: tuple[int, ...]
    sums: Sums
    matches: tuple[tuple[Gated, ...], ...]
    places: PlaceSums
    settled: tuple[str, ...]
    steps: Array
    weights: Array
    shared: Array
    bends: Array
    walks: Sums
    evidence: Array
    walk: Numbers
    groups: Array
    lens: tuple[Array, ...]
    lens_errors: Array
    travel: Array
    curvature: Array
    total: Array
    total_hessian: Array
    total_frames: Array
    started: Mask
    scales: tuple[ResidualScale, ...]
    share: Array
    absent: Numbers
    moved_at: Numbers
    drift_reported_at: Numbers
    counts: Numbers
    waiting: tuple[tuple[Correspondences, ...], ...]
    refused: tuple[tuple[str, ...], ...]
    outliers: tuple[tuple[Gated, ...], ...]
    agreements: tuple[tuple[tuple[int, bool], ...], ...]
    dropped_pairs: tuple[int, ...] = ()
    contradicting: tuple[int, ...] = ()
    drift: DriftWatch | None = None
    findings: MatcherFindings = field(default_factory=MatcherFindings)
    ratios: VarianceRatios = VarianceRatios()
    stamp_ns: int | None = None
    updates: int = 0
    moves: tuple[Event, ...] = ()
    motion: str | None = None

    @staticmethod
    def initial(rig: Rig, config: Config) -> State:
        """Before the first frame.

        Raises:
            ValueError: if a lens or clock is to be estimated.
        """
        require_poses_alone(config)
        n, walks = len(rig.cameras), len(STRENGTHS)
        guess = np.array([*rig.T_camera_lidar.values()])
        none: tuple[tuple[Any, ...], ...] = ((),) * n
        return State(
            rig=rig,
            config=config,
            references=guess,
            numbers=np.zeros(0, np.int64),
            at=(),
            sizes=(0,),
            sums=Sums.zeros(0, n),
            matches=none,
            places=PlaceSums.empty(n),
            settled=(),
            steps=np.zeros((0, n, 6)),
            weights=np.ones((0, 1 + n)),
            shared=np.zeros((n, 6)),
            bends=np.zeros((n, BEND)),
            walks=Sums.zeros(n, walks),
            evidence=np.zeros((n, walks)),
            walk=np.zeros(n, np.int64),
            groups=np.zeros((n, 2)),
            lens=(np.zeros((6, 6)),) * n,
            lens_errors=np.zeros((n, 6, 6)),
            travel=np.zeros((n, 6, 3)),
            curvature=np.tile(np.eye(6), (n, 1, 1)),
            total=np.zeros((6 * n, 6 * n)),
            total_hessian=np.zeros((n, 6, 6)),
            total_frames=np.zeros(n),
            started=np.zeros(n, np.bool_),
            scales=(ResidualScale(1.0, 1.0, 1.0, 1.0),) * n,
            share=np.ones(n),
            absent=np.zeros(n, np.int64),
            moved_at=np.full(n, -1),
            drift_reported_at=np.full(n, -1),
            counts=np.zeros((n, len(COUNTS)), np.int64),
            waiting=none,
            refused=none,
            outliers=none,
            agreements=none,
        )

    def draft(self) -> State:
        """A copy whose arrays may be replaced."""
        found = object.__new__(State)  # copy.copy makes ten times the calls
        vars(found).update(vars(self))
        return found

    def put(self, camera: int, **values: Any) -> None:
        """Replace one camera's part of some arrays or tuples."""
        for name, value in values.items():
            before = getattr(self, name)
            if isinstance(before, tuple):
                after: Any = (*before[:camera], value, *before[camera + 1 :])
            elif isinstance(before, Sums):
                after = before.replace_at(camera, value)
            else:
                after = before.copy()
                after[camera] = value
            setattr(self, name, after)

    def count(self, camera: int, **more: int) -> None:
        """Raise some counts of a camera."""
        self.counts = self.counts.copy()
        for name, number in more.items():
            self.counts[camera, COUNTS.index(name)] += number

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(self.rig.cameras)

    @property
    def frame(self) -> int | None:
        """Number of the last frame, None before the first."""
        return int(self.numbers[-1]) if len(self.numbers) else None

    @property
    def closed(self) -> int:
        """How many of the frames are of closed epochs: the first ones."""
        return len(self.numbers) - self.sizes[-1]

    @property
    def edges(self) -> list[int]:
        """(E + 1,) first row of each epoch's frames, and the end."""
        return [*accumulate(self.sizes, initial=0)]

    @property
    def drifting(self) -> list[int]:
        """The cameras that are followed by a random walk, by their places in the rig."""
        found: list[int] = self.walk.nonzero()[0].tolist()
        return found

    def matches_of(self, camera: int) -> Gated | None:
        """A camera's matches in all frames; None if it has none. They are joined, and remain so."""
        if not self.matches[camera]:
            return None
        if len(self.matches[camera]) > 1:
            self.put(camera, matches=(Gated.join(self.matches[camera]),))
        return self.matches[camera][0]

    def settled_rows(self, names: Iterable[str]) -> Numbers:
        """(k,) which of the places with a known optimum they are; -1: of none."""
        row_of = dict(zip(self.settled, range(len(self.settled)), strict=True))
        return np.array([row_of.get(name, -1) for name in names], dtype=np.int64)

    def first_row(self, number: int) -> int:
        """The first of the frames that is not before a number."""
        return int(np.searchsorted(self.numbers, number))

    def with_moves(self, events: Sequence[Event]) -> None:
        """Keep further moves."""
        self.moves = (*self.moves, *events)[-_MOST_MOVES:]

    def rig_at(self, T_camera_lidar: Array) -> Rig:
        """The rig with (n, 4, 4) estimates."""
        return self.rig.moved_to(dict(zip(self.names, T_camera_lidar, strict=True)))

    def walk_variance(self, strengths: Array, frames: int) -> Array:
        """(w, 6) variance of walks of (w,) strengths, in units of the configured one."""
        tracking = self.config.tracking
        rotation = np.radians(tracking.walk_rotation_deg) ** 2
        whole = np.repeat([rotation, tracking.walk_translation_m**2], 3) * frames
        return np.outer(strengths**2, whole)

    @property
    def is_known(self) -> Mask:
        """(n,) whether the scatter of a camera's frames is."""
        return np.asarray(self.total_frames >= LEAST_FRAMES)

    @property
    def scatter_of_frames(self) -> Array:
        """(n, 6, 6) scatter of one frame's gradient, by frames alone, where it is known."""
        frames = np.maximum(self.total_frames - 1, 1.0)
        return diagonal_blocks(self.total) / frames[:, None, None]

    @property
    def frame_noise(self) -> Array:
        """(n, 6, 6) the same times the inflation: the ratio of the scatter of epochs to theirs."""
        return self.scatter_of_frames * inflation(self.groups)[:, None, None]

    @property
    def overconfidence(self) -> Array:
        """(n,) mean ratio of each camera's Hessian to its information, at least 1."""
        found, known = np.ones(len(self.names)), self.is_known
        share = np.linalg.solve(self.total_hessian[known], diagonal_blocks(self.total)[known])
        found[known] = np.maximum(np.trace(share, axis1=1, axis2=2) / 6, 1.0)
        return found

    # Sums over epochs, older ones discounted by the random walk of a camera that drifts.

    def sums_of_epochs(self, before: int | None = None) -> Sums:
        """(E, n) of each epoch, of frames before a number."""
        end = len(self.numbers) if before is None else self.first_row(before)
        none = Sums.zeros(1, len(self.names))  # of an epoch without frames
        frames = np.concatenate([self.sums.packed[:end], none.packed])
        return Sums(np.add.reduceat(frames, np.minimum(self.edges[:-1], end)))

    def sums_before_epochs(self, before: int | None = None) -> Sums:
        """(E + 1, n) over the frames before each epoch, the older ones too; and over all of them.

        Args:
            before: number of a frame from which on none counts.
        """
        sums = self.walks[np.arange(len(self.walk)), self.walk]
        of_epochs = self.sums_of_epochs(before)
        if not self.walk.any():
            return Sums(np.concatenate([sums.packed[None], of_epochs.packed]).cumsum(axis=0))
        found = [sums.packed]
        for epoch, size in zip(of_epochs.packed[:-1], self.sizes[:-1], strict=True):
            variance = self.walk_variance(STRENGTHS[self.walk], size)
            sums = Sums(sums.packed + epoch).after_walk(variance, self.overconfidence)
            found.append(sums.packed)
        return Sums(np.array([*found, sums.packed + of_epochs.packed[-1]]))

    def all_sums(self, before: int | None = None) -> Sums:
        """(n,) over all frames, or those before a frame's number."""
        return self.sums_before_epochs(before)[-1]


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


def rows_of(cameras: Iterable[int]) -> NDArray[np.intp]:
    """The rows of some cameras in a joint vector or matrix of all."""
    return np.add.outer(6 * np.array([*cameras], dtype=np.intp), np.arange(6)).ravel()

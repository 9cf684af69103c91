"""What a fleet knows: the nominal pose of every camera, and every vehicle's deviation from it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.audit.mounts import Mount, Pooled, fit_mounts
from calibgraph.audit.observations import Observations


@dataclass(frozen=True, eq=False)
class ModelFit:
    """One model of vehicle: the mounts that enough vehicles measured, and what they share."""

    mounts: Mapping[str, Mount]
    pooled: Pooled


@dataclass(frozen=True, eq=False)
class FleetModel:
    """All models of a fleet, and its vehicles as they follow from them.

    Attributes:
        observations: the rows.
        models: per model with at least one camera that enough vehicles measured.
        T_camera_lidar: (n, 4, 4) shrunk estimate of each row; as measured where its mount is
            unknown.
        covariance: (n, 6, 6) of it.
        deviation: (n, 6) measured deviation from the nominal pose of its batch; NaN if unknown.
        moved: (n,) probability that the camera was moved in its mount; NaN if unknown.
    """

    observations: Observations
    models: Mapping[str, ModelFit]
    T_camera_lidar: Array
    covariance: Array
    deviation: Array
    moved: Array

    @cached_property
    def apart(self) -> NDArray[np.bool_]:
        """(n,) rows that are flagged; about one flag in a hundred is false."""
        return likely(self.moved, self.observations.measured)


FALSE_DISCOVERIES = 0.01
"""Expected share of wrong ones among everything that is flagged."""


def likely(probability: Array, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest set whose expected share of wrong members is at most FALSE_DISCOVERIES."""
    wrong = np.where(among & np.isfinite(probability), 1.0 - probability, 1.0)
    order = np.argsort(wrong, kind="stable")
    expected = np.cumsum(wrong[order]) / np.arange(1, len(order) + 1)
    chosen = np.zeros(len(order), dtype=np.bool_)
    chosen[order[: np.count_nonzero(expected <= FALSE_DISCOVERIES)]] = True
    return chosen


def fit_fleet(observations: Observations) -> FleetModel:
    """The hierarchical model of a fleet, and its vehicles' cameras shrunk towards it.

    Vehicles of a model and batch scatter about the batch's nominal pose, batches about the
    model's; both spreads are learnt, and so is how many cameras were moved and how far. A
    measurement with a small error bar stays as it is; one with a large one moves to its batch.

    Args:
        observations: one row per vehicle and camera.
    """
    fits = {str(name): fit_mounts(observations.select(observations.model == name))
            for name in np.unique(observations.model)}  # fmt: skip
    models = {name: ModelFit({mount.camera: mount for mount in mounts}, pooled)
              for name, (mounts, pooled) in fits.items() if mounts}  # fmt: skip
    n = len(observations.vehicle)
    T, covariance = observations.T_camera_lidar.copy(), observations.covariance.copy()
    deviation, moved = np.full((n, 6), np.nan), np.full(n, np.nan)
    for name, model in models.items():
        for camera, mount in model.mounts.items():
            rows = np.flatnonzero((observations.model == name) & (observations.camera == camera))
            everyone = mount.of_all(observations.select(rows), model.pooled)
            deviation[rows] = everyone.deviations()
            moved[rows] = everyone.weigh(model.pooled).share[1]
            T[rows], covariance[rows] = everyone.shrink(model.pooled)
    return FleetModel(observations, models, T, covariance, deviation, moved)


def expected_pose(mount: Mount, pooled: Pooled) -> tuple[Array, Array]:
    """Where a further vehicle's camera is, unless it is moved in its mount.

    Returns:
        (4, 4) T_camera_lidar; (6, 6) covariance of xi in T_camera_lidar = exp(xi) that, which
        holds the spread of vehicles and batches and the uncertainty of the nominal pose.
    """
    between = mount.centers.nominal_covariance + pooled.batch * mount.spread
    return mount.centers.nominal, mount.spread + between

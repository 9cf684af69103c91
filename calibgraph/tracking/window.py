"""The graph that is reported, in iSAM2: what all places share, and the places of the open epoch.

    held        summary of the other closed places: one marginal on the cloud and the cameras;
                priors and relative poses of the cameras
    errors      of what all places share, the scan distortion among them: as in a batch
    places      those of the open epoch, with their data

Every frame exchanges errors and places: their covariances depend on all frames. What is reported is
iSAM2's estimate and its joint marginal. Whatever else changes the graph, such as the end of an
epoch or a place that is entered, begins another window.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import LatentPoseModel, data_graph
from calibgraph.graph.objective import join

_RELINEARIZE = 1e-5  # rad and m: far below any sigma
_MOST_STEPS = 20  # of Gauss-Newton: from frame to frame one or two do


class Window:
    """iSAM2 on the graph of an open epoch.

    Args:
        model: the graph.
        places: names of its places.
        start: values of all its variables.

    Raises:
        RuntimeError: if a variable is not determined.
    """

    def __init__(self, model: LatentPoseModel, places: Sequence[str], start: gtsam.Values) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("QR")  # Cholesky takes sigmas 4096 times apart for singular
        parameters.setRelinearizeThreshold(_RELINEARIZE)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._isam = gtsam.ISAM2(parameters)
        self.places = tuple(places)
        self._exchanged: list[int] = []
        self._update(model, model.pose_graph, start)

    def has_graph_of(self, model: LatentPoseModel, places: Sequence[str]) -> bool:
        """Whether a model has the variables and the held factors of this one."""
        same = self.model.pose_graph is model.pose_graph and self.places == tuple(places)
        return same and self.model.matched_places == model.matched_places

    def exchange(self, model: LatentPoseModel) -> None:
        """Put the errors and places of a model in the place of those before."""
        self._update(model, gtsam.NonlinearFactorGraph(), gtsam.Values())

    def _update(
        self, model: LatentPoseModel, held: gtsam.NonlinearFactorGraph, start: gtsam.Values
    ) -> None:
        graph = join(held, model.error_graph, model.place_graph, data_graph(model))
        result = self._isam.update(graph, start, self._exchanged)
        self._exchanged = [*result.getNewFactorsIndices()][held.size() :]
        for _ in range(_MOST_STEPS):
            if not self._isam.update().getVariablesRelinearized():
                break
        self.model, self.values = model, self._isam.calculateEstimate()

    def T_lidar_camera(self, keys: Sequence[int]) -> tuple[gtsam.Pose3, ...]:
        """The estimates of some poses."""
        return tuple(map(self.values.atPose3, keys))

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint marginal of some variables, in their tangents."""
        return np.asarray(self._isam.jointMarginalCovariance(keys).fullMatrix())

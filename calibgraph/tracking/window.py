"""What all places share, in iSAM2: priors and relative poses, errors of sensor and matcher.

The places are one factor on the cloud and on the cameras as matches show them; every update
exchanges it. The graph is linear but for its priors, and linearized at the references of the epoch.
One exchange of a blank factor comes first: from then on iSAM2 eliminates in one order, so that its
numbers depend on the last factor alone, to the last bit, and a restart gives the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import LatentPoseModel, to_ordering
from calibgraph.graph.variables import CLOUD, DISTORTION, camera_key, matched_key
from calibgraph.model.config import Reported
from calibgraph.model.geometry import adjoints, to_T_lidar_camera

_RELINEARIZE = 0.1  # rad and m: beyond all that an epoch may move
_ROUNDING = 1e-11  # of the diagonal: what cloud and cameras share leaves a quadratic open
_POSE = 6


class Window:
    """iSAM2 on the graph of an epoch.

    Args:
        model: the graph; of its data and places nothing is used.
        references: (n, 4, 4) T_camera_lidar at which it is linearized.

    Raises:
        RuntimeError: if a variable is not determined.
    """

    def __init__(self, model: LatentPoseModel, references: Array) -> None:
        self.model, cameras = model, range(len(references))
        self._poses, shared = [*map(to_T_lidar_camera, references)], gtsam.Values()
        self._keys, self._start = [CLOUD, *map(matched_key, cameras)], gtsam.Values()
        for key, pose in zip(self._keys, [gtsam.Pose3(), *self._poses], strict=True):
            self._start.insert(key, pose)
        for camera, pose in enumerate(self._poses):
            shared.insert(camera_key(camera), pose)
        distortion = [DISTORTION] if model.is_distorted else []
        self._mount_keys = [*model.camera_keys, *distortion]
        if model.is_distorted:
            shared.insert(DISTORTION, np.zeros(model.components.distortion_jacobian.shape[2]))
        shared.insert(self._start)
        rows = [slice(row, row + _POSE) for row in range(0, _POSE * len(self._keys), _POSE)]
        self._pairs = [*combinations(zip(self._keys, rows, strict=True), 2)]
        self._mount_columns = model.columns_of(self._mount_keys)
        size = _POSE * len(cameras)
        self.chain = np.hstack([-adjoints(references).reshape(-1, _POSE), np.eye(size)])
        self._rounded = 1.0 + _ROUNDING * np.eye(_POSE + size)
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("QR")  # Cholesky takes sigmas 4096 times apart for singular
        parameters.setRelinearizeThreshold(_RELINEARIZE)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._isam, self._all, self._slots = gtsam.ISAM2(parameters), shared, list[int]()
        self._isam.update(model.shared_graph, shared)
        self.exchange(self.chain.T @ self.chain, np.zeros(_POSE + size))

    def exchange(self, hessian: Array, gradient: Array) -> None:
        """Put a quadratic on the cloud and the cameras in the place of the one before.

        Args:
            hessian: (6 + 6 n, 6 + 6 n).
            gradient: (6 + 6 n,) at the references.
        """
        graph = gtsam.NonlinearFactorGraph()
        whole = self._factor(hessian * self._rounded, -gradient)
        graph.add(gtsam.LinearContainerFactor(whole, self._start))
        result = self._isam.update(graph, gtsam.Values(), self._slots)
        self._slots = [*result.getNewFactorsIndices()]
        self.values = self._isam.calculateBestEstimate()  # by all changes, however small

    def _factor(self, hessian: Array, vector: Array) -> gtsam.HessianFactor:
        """The quadratic as one factor, from those of pairs that share what is of one variable."""
        parts, share = gtsam.GaussianFactorGraph(), 1.0 / (len(self._keys) - 1)
        own, pull = share * hessian, share * vector
        for (a, one), (b, two) in self._pairs:
            of_both = own[one, one], hessian[one, two], pull[one], own[two, two], pull[two]
            parts.push_back(gtsam.HessianFactor(a, b, *of_both, 0.0))
        return gtsam.HessianFactor(parts)

    @property
    def shown(self) -> Array:
        """(n, 6) from the references to where matches show the cameras at all places."""
        cloud = self.values.atPose3(CLOUD)
        return self._away([cloud.between(self.values.atPose3(key)) for key in self._keys[1:]])

    def steps(self, keys: Sequence[int]) -> Array:
        """(6 n,) from the references to the estimates of some poses, one of each camera."""
        return self._away([*map(self.values.atPose3, keys)]).ravel()

    def _away(self, poses: Sequence[gtsam.Pose3]) -> Array:
        pairs = zip(self._poses, poses, strict=True)
        return np.array([reference.localCoordinates(pose) for reference, pose in pairs])

    def reported(self, of: Reported) -> tuple[Array, Array]:
        """(n, 4, 4) T_camera_lidar of mounts or alignments; (6 n, 6 n) their marginal."""
        T, rows = self.model.reported(self.values, of)
        rows = rows[:, self._mount_columns]
        return T, rows @ self.covariance(self._mount_keys) @ rows.T

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint marginal of some variables, in their tangents."""
        return np.asarray(self._isam.jointMarginalCovariance(keys).fullMatrix())

    @property
    def covariance_of_shown(self) -> Array:
        """(6 n, 6 n) of :attr:`shown`."""
        return np.asarray(self.chain @ self.covariance(self._keys) @ self.chain.T)

    @property
    def squared_errors(self) -> float:
        """Twice GTSAM's error of the shared errors, linearized as iSAM2 does."""
        linear = self.model.error_graph.linearize(self._all)
        return 2.0 * float(linear.error(self._all.localCoordinates(self.values)))

    def undetermined(self) -> float:
        """Degrees of freedom of the shared errors that the data leave open."""
        errors = self.model.error_graph
        keys = [*errors.keyVector()]
        known = errors.linearize(self.values).hessian(to_ordering(keys))[0]
        return float((known * self.covariance(keys)).sum())

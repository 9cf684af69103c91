"""The data of the error model as GTSAM ``HessianFactor``s, from one pass over each block."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.by_place import PairByPlace
from calibgraph.graph.latent_poses import LatentPoseModel, to_ordering
from calibgraph.graph.lens import FreeLensByPlace
from calibgraph.graph.variables import cloud_at_key, matched_at_key, paired_key
from calibgraph.model.geometry import adjoints, invert_each


@dataclass(eq=False)
class LinearData:
    """Quadratics of all correspondences and camera-to-camera matches at given poses.

    They are those of :func:`calibgraph.graph.latent_poses.data_graph`, whatever the variance
    components.

    Attributes:
        graph: one factor per camera and place, and per pair and place.
        cost: twice GTSAM's error at these poses.
    """

    graph: gtsam.GaussianFactorGraph = field(default_factory=gtsam.GaussianFactorGraph)
    cost: float = 0.0

    @staticmethod
    def at(model: LatentPoseModel, values: gtsam.Values) -> LinearData:
        """Linearize the data.

        Args:
            model: whose data are linearized.
            values: of all poses.
        """
        data = LinearData()
        clouds = [values.atPose3(cloud_at_key(place)) for place in range(model.places)]
        for number in model.matched:
            data._add_block(model, number, values, clouds)
        for pair in model.pairs:
            data._add_pair(model, pair, values, np.array([pose.matrix() for pose in clouds]))
        return data

    def _add_block(
        self,
        model: LatentPoseModel,
        number: int,
        values: gtsam.Values,
        clouds: Sequence[gtsam.Pose3],
    ) -> None:
        """Correspondences of one camera, on o_p^-1 a_cp."""
        block = model.blocks[model.cameras[number]]
        places, T_camera_cloud = block.places, np.tile(np.eye(4), (len(clouds), 1, 1))
        keys = [matched_at_key(place, number) for place in places.tolist()]
        pairs = zip(keys, places.tolist(), strict=True)
        poses = [values.atPose3(key).between(clouds[place]) for key, place in pairs]
        T_camera_cloud[places] = [pose.matrix() for pose in poses]
        if isinstance(block, FreeLensByPlace):
            self._add_free_lens(block, keys, values, T_camera_cloud[places])
            return
        sums = block.sums(T_camera_cloud)
        by_cloud = -np.array([pose.AdjointMap() for pose in poses])
        hessian, gradient, cost = sums.hessian[places], sums.gradient[places], sums.cost[places]
        across = by_cloud.transpose(0, 2, 1) @ hessian
        cloud, pull = across @ by_cloud, -np.einsum("pij,pi->pj", by_cloud, gradient)
        self.cost += float(cost.sum())
        for row, (place, key) in enumerate(zip(places, keys, strict=True)):
            self.graph.push_back(
                gtsam.HessianFactor(
                    cloud_at_key(int(place)), key,
                    cloud[row], across[row], pull[row], hessian[row], -gradient[row], cost[row],
                )
            )  # fmt: skip

    def _add_free_lens(
        self,
        block: FreeLensByPlace,
        keys: Sequence[int],
        values: gtsam.Values,
        T_camera_cloud: Array,
    ) -> None:
        """The same with a free lens, on o_p^-1 a_cp and s_c."""
        by_cloud = -adjoints(T_camera_cloud)
        sums = block.sums(T_camera_cloud, values.atVector(block.key))
        for number, (place, key) in enumerate(zip(block.places, keys, strict=True)):
            one, size = sums[number], len(sums[number].gradient)
            chain = np.hstack(
                [np.vstack([by_cloud[number], np.zeros((size - 6, 6))]), np.eye(size)]
            )
            hessian, pull = chain.T @ one.hessian @ chain, -chain.T @ one.gradient
            cloud, pose, lens = slice(6), slice(6, 12), slice(12, None)
            self.cost += float(one.cost)
            self.graph.push_back(
                gtsam.HessianFactor(
                    cloud_at_key(int(place)), key, block.key,
                    hessian[cloud, cloud], hessian[cloud, pose], hessian[cloud, lens], pull[cloud],
                    hessian[pose, pose], hessian[pose, lens], pull[pose],
                    hessian[lens, lens], pull[lens], float(one.cost),
                )
            )  # fmt: skip

    def _add_pair(
        self, model: LatentPoseModel, pair: PairByPlace, values: gtsam.Values, clouds: Array
    ) -> None:
        """Features that two cameras share, on o_p^-1 n_a and o_p^-1 n_b."""
        keys = [paired_key(model.cameras.index(name)) for name in (pair.a, pair.b)]
        shown, here = poses_of(values, keys), clouds[pair.places]
        seen = [invert_each(here) @ pose for pose in shown]
        sums = pair.block.run_sums(seen[0], seen[1], pair.edges)
        chain = np.concatenate([-adjoints(invert_each(pose)) for pose in seen], axis=1)
        across = chain.transpose(0, 2, 1) @ sums.hessian
        cloud, pull = across @ chain, -np.einsum("pij,pi->pj", chain, sums.gradient)
        self.cost += float(sums.cost.sum())
        for row, place in enumerate(pair.places):
            hessian, gradient = sums.hessian[row], -sums.gradient[row]
            self.graph.push_back(
                gtsam.HessianFactor(
                    cloud_at_key(int(place)), keys[0], keys[1],
                    cloud[row], across[row, :, :6], across[row, :, 6:], pull[row],
                    hessian[:6, :6], hessian[:6, 6:], gradient[:6],
                    hessian[6:, 6:], gradient[6:], sums.cost[row],
                )
            )  # fmt: skip


def poses_of(values: gtsam.Values, keys: Iterable[int]) -> Array:
    """(n, 4, 4) of some poses."""
    return np.array([values.atPose3(key).matrix() for key in keys]).reshape(-1, 4, 4)


def marginal_information(
    graph: gtsam.GaussianFactorGraph, keys: Sequence[int], kept: Sequence[int]
) -> Array:
    """The marginal information of some variables.

    Variables are eliminated one by one: with several at a time GTSAM takes a graph for
    indeterminate as soon as two standard deviations differ by a factor of 4096.

    Args:
        graph: linear factors.
        keys: all its variables, in the order in which they are eliminated.
        kept: those whose information is wanted.

    Raises:
        RuntimeError: if one of the others is not determined.
    """
    others = to_ordering(key for key in keys if key not in kept)
    left = graph.eliminatePartialSequential(others)[1]
    return np.asarray(left.hessian(to_ordering(kept))[0])

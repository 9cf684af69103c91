"""What the next vehicle of a model starts from: nominal poses and relative poses, with sigmas."""

import math

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import RigError
from calibgraph.fleet.fit import Mount, Pooled
from calibgraph.fleet.model import ModelFit
from calibgraph.model.geometry import invert
from calibgraph.model.rig import RelativePose, Rig

_LEAST_SIGMA = 1e-5  # of a relative pose in a rig file


def expected_pose(mount: Mount, pooled: Pooled, batch: str | None = None) -> tuple[Array, Array]:
    """Where a further vehicle's camera is, unless it is moved in its mount.

    Returns:
        (4, 4) T_camera_lidar; (6, 6) covariance of xi in T_camera_lidar = exp(xi) that, which
        holds the spread of vehicles and batches and the uncertainty of the nominal pose.
    """
    centers = mount.centers
    if batch is None:
        between = centers.nominal_covariance + pooled.batch * mount.spread
        return centers.nominal, mount.spread + between
    if batch not in mount.batches:
        raise ValueError(
            f"unknown batch {batch!r} of camera {mount.camera!r}; known are "
            f"{', '.join(mount.batches)}"
        )
    index = mount.batches.index(batch)
    return centers.batches[index], mount.spread + centers.batch_covariance[index]


def prior_rig(rig: Rig, model: ModelFit, batch: str | None = None) -> Rig:
    """A rig for a further vehicle: its guess, and relative poses that `solve` takes as measured.

    Every relative pose is from the first camera. Its sigma is that of the axis along which it
    varies most, because a rig file has one for all axes; so it is never too small. Errors of two
    relative poses share the deviation of the first camera, which the solve does not take into
    account.

    Raises:
        RigError: if the rig has a camera that the fleet has not measured.
    """
    unknown = [name for name in rig.cameras if name not in model.mounts]
    if unknown:
        raise RigError(
            f"camera {unknown[0]!r} of the rig is not among the fleet's "
            f"{', '.join(model.mounts)}; give it the same name in both, or take it out",
            camera=unknown[0],
        )
    pairs = [mount for name, mount in model.pairs.items() if name in rig.cameras]
    if model.reference not in rig.cameras:
        pairs = []
    poses = {name: expected_pose(model.mounts[name], model.pooled, batch)[0]
             for name in rig.cameras}  # fmt: skip
    relative = [_relative_pose(model.reference, pair, model.pooled_pairs, batch) for pair in pairs]
    return rig.moved_to(poses).model_copy(update={"relative_poses": tuple(relative)})


def _relative_pose(reference: str, pair: Mount, pooled: Pooled, batch: str | None) -> RelativePose:
    """The pose of one camera in the first one."""
    known = batch if batch in pair.batches else None
    T_b_a, covariance = expected_pose(pair, pooled, known)
    return RelativePose(
        a=reference,
        b=pair.camera,
        T_a_b=invert(T_b_a),
        rotation_sigma_rad=_widest(covariance[:3, :3]),
        translation_sigma_m=_widest(covariance[3:, 3:]),
    )


def _widest(covariance: Array) -> float:
    """Standard deviation along the axis that varies most."""
    return max(_LEAST_SIGMA, math.sqrt(float(np.linalg.eigvalsh(covariance)[-1])))

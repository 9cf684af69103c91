"""Results of one rig, with errors drawn from their covariances."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np

import calibgraph
from calibgraph import Calibration, simulate_correspondences
from tests.conftest import make_pair

AXES = {"pitch": 0, "yaw": 1, "roll": 2, "right": 3, "down": 4, "ahead": 5}


@cache
def template() -> Calibration:
    """A result of the pair; its covariances are those of all."""
    table = simulate_correspondences(make_pair(), frames=8, matches=60)
    return replace(calibgraph.solve(make_pair(), table), correspondences=None)


def moved(rig: calibgraph.Rig, motions: Mapping[str, np.ndarray]) -> calibgraph.Rig:
    """The rig with cameras moved by (6,) twists in their own axes."""
    T = rig.T_camera_lidar
    return rig.moved_to(
        {**T, **{k: gtsam.Pose3.Expmap(-xi).matrix() @ T[k] for k, xi in motions.items()}}
    )


def twist(axis: str, size: float) -> np.ndarray:
    """A motion about or along one axis [deg or cm]."""
    xi = np.zeros(6)
    xi[AXES[axis]] = np.radians(size) if AXES[axis] < 3 else size / 100
    return xi


def draw(
    rng: np.random.Generator, motions: Mapping[str, np.ndarray] | None = None, *, wider: float = 1.0
) -> Calibration:
    """A result: the truth, cameras moved, an error of the template's covariance times wider^2."""
    of = template()
    joint = of.joint_covariance * wider**2
    errors = rng.multivariate_normal(np.zeros(12), joint).reshape(2, 6)
    rig = moved(moved(make_pair(), motions or {}), dict(zip(of.rig.cameras, errors, strict=True)))
    covariance = {name: joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
                  for k, name in enumerate(of.rig.cameras)}  # fmt: skip
    return replace(of, rig=rig, covariance=covariance, joint_covariance=joint)

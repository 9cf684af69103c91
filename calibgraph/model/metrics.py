"""The paper's metrics: an estimate against a reference, per camera and between cameras."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.errors import RigError
from calibgraph.model.geometry import angle_deg, relative_transform
from calibgraph.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseError:
    """Difference of two rigid transforms (paper, "Evaluation Metrics").

    Attributes:
        rotation_error_deg: E_R, the angle of Delta R = R_est R_ref^T.
        translation_error_cm: E_t = |t_est - t_ref|.
        x_cm, y_cm, z_cm: t_est - t_ref, signed, along the camera's axes.
        roll_deg, pitch_deg, yaw_deg: Delta R as signed rotations about the axes that these words
            mean for a vehicle looking along the camera's z axis: roll about z (forward), pitch
            about x (right), yaw about y (down); components of its rotation vector.
    """

    rotation_error_deg: float
    translation_error_cm: float
    x_cm: float
    y_cm: float
    z_cm: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float


@dataclass(frozen=True)
class Evaluation:
    """Errors of all cameras, and of all pairs.

    The pair ``"A->B"`` is T_B_A = T_B_lidar T_A_lidar^-1, which maps coordinates in A to
    coordinates in B; its errors are along the axes of B.
    """

    cameras: dict[str, PoseError]
    pairs: dict[str, PoseError]

    def to_mapping(self) -> dict[str, Any]:
        """As plain numbers, for JSON."""
        return {
            "cameras": {name: asdict(error) for name, error in self.cameras.items()},
            "pairs": {name: asdict(error) for name, error in self.pairs.items()},
        }


def evaluate(estimate: Rig, reference: Rig) -> Evaluation:
    """Compare the extrinsics of two rigs.

    Raises:
        RigError: if a camera of the estimate is not in the reference.
    """
    for name in estimate.cameras:
        if name not in reference.cameras:
            raise RigError(
                f"camera {name!r} of the estimate is not in the reference, which has "
                f"{', '.join(map(repr, reference.cameras))}; give it the same name in both",
                camera=name,
            )
    found, true = estimate.T_camera_lidar, reference.T_camera_lidar
    cameras = {name: pose_error(found[name], true[name]) for name in found}
    pairs = {
        f"{a}->{b}": pose_error(
            relative_transform(found[b], found[a]), relative_transform(true[b], true[a])
        )
        for a, b in combinations(found, 2)
    }
    return Evaluation(cameras, pairs)


def pose_error(estimate: Array, reference: Array) -> PoseError:
    """Difference of two (4, 4) transforms into the same camera."""
    rotation = estimate[:3, :3] @ reference[:3, :3].T
    shift = 100.0 * (estimate[:3, 3] - reference[:3, 3])
    about_x, about_y, about_z = np.degrees(Rotation.from_matrix(rotation).as_rotvec())
    return PoseError(
        rotation_error_deg=angle_deg(rotation),
        translation_error_cm=float(np.linalg.norm(shift)),
        x_cm=float(shift[0]),
        y_cm=float(shift[1]),
        z_cm=float(shift[2]),
        roll_deg=float(about_z),
        pitch_deg=float(about_x),
        yaw_deg=float(about_y),
    )

"""All of SE(3): the only module of ``calibgraph`` that inverts a transform.

``T_a_b`` maps coordinates in b to coordinates in a. Files, results and public functions hold
``T_camera_lidar``, a (4, 4) array; GTSAM's variables are ``T_lidar_camera``, a ``Pose3``.
Tangent vectors are (rotation [rad], translation [m]).
"""

import math
from collections.abc import Container, Mapping, Sequence
from itertools import combinations

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from factors.pose_kernel import exponential_times, logarithms


def transform(rotation: Rotation | ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """(4, 4) of a rotation, or its (3, 3) matrix, and a (3,) translation."""
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix() if isinstance(rotation, Rotation) else rotation
    T[:3, 3] = translation
    return T


def invert(T_a_b: Array) -> Array:
    """(4, 4) T_b_a, or (f, 4, 4) of as many."""
    inverse = np.zeros(T_a_b.shape)
    inverse[..., :3, :3] = T_a_b[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ T_a_b[..., :3, 3:]
    inverse[..., 3, 3] = 1.0
    return inverse


def move_points(points_b: Array, T_a_b: Array) -> Array:
    """(n, 3) points in the frame a, of points in b."""
    return np.asarray(points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])


def relative_transform(T_a_c: Array, T_b_c: Array) -> Array:
    """(4, 4) T_a_b = T_a_c T_b_c^-1: of two cameras, from both extrinsics (paper, Eq. 3)."""
    T_a_b: Array = T_a_c @ np.linalg.inv(T_b_c)
    return T_a_b


def to_T_lidar_camera(T_camera_lidar: Array) -> gtsam.Pose3:
    """The graph's variable for an extrinsic."""
    return gtsam.Pose3(T_camera_lidar).inverse()


def to_T_camera_lidar(T_lidar_camera: gtsam.Pose3) -> Array:
    """(4, 4) the extrinsic for a variable of the graph."""
    T_camera_lidar: Array = T_lidar_camera.inverse().matrix()
    return T_camera_lidar


T_OPTICAL_LINK: Array = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From ROS's camera link (x forward, y left, z up) to the optical frame of the same camera."""
T_OPTICAL_LINK.setflags(write=False)


def ros_pose_covariance(covariance: Array, T_camera_lidar: Array) -> Array:
    """(6, 6) covariance of the camera's pose in the LiDAR frame, as ``PoseWithCovariance`` has it.

    Args:
        covariance: (6, 6) of xi in T_camera_lidar = exp(xi) estimate, rotation first.
        T_camera_lidar: (4, 4) the estimate.

    Returns:
        Of the position [m], then of the rotation [rad] about fixed axes, both in LiDAR axes.
    """
    # T_lidar_camera exp(-xi): the position moves by -R v, the axes turn by -R w.
    jacobian = np.zeros((6, 6))
    jacobian[:3, 3:] = jacobian[3:, :3] = -T_camera_lidar[:3, :3].T
    turned: Array = jacobian @ covariance @ jacobian.T
    return turned


def camera_center(T_camera_lidar: Array) -> Array:
    """(3,) the camera's centre in the LiDAR frame [m]."""
    center: Array = -T_camera_lidar[:3, :3].T @ T_camera_lidar[:3, 3]
    return center


def point_in_lidar(T_camera_lidar: Array, point_camera_m: Array) -> Array:
    """(3,) a point of the camera frame in the LiDAR frame [m]."""
    point_lidar_m: Array = T_camera_lidar[:3, :3].T @ (point_camera_m - T_camera_lidar[:3, 3])
    return point_lidar_m


def planes_in_lidar(planes_camera_per_m: Array, T_camera_lidar: Array) -> Array:
    """(n, 3) planes q . p = 1 of the LiDAR frame, from g . X = 1 of the camera frame [1/m]."""
    R, t = T_camera_lidar[:3, :3], T_camera_lidar[:3, 3]
    planes: Array = (planes_camera_per_m @ R) / (1.0 - planes_camera_per_m @ t)[:, None]
    return planes


def inverse_ranges(rays: Array, planes_lidar_per_m: Array, T_camera_lidar: Array) -> Array:
    """(n,) inverse ranges [1/m] at which rays of the camera frame meet planes of the LiDAR's.

    Args:
        rays: (n, 3) unit vectors in the camera frame.
        planes_lidar_per_m: (n, 3) q, with q . p = 1 for points p of the plane.
        T_camera_lidar: (4, 4).
    """
    across = np.einsum("ni,ni->n", planes_lidar_per_m, rays @ T_camera_lidar[:3, :3])
    inverse: Array = across / (1.0 - planes_lidar_per_m @ camera_center(T_camera_lidar))
    return inverse


def angle_deg(R: Array) -> float:
    """Angle of a (3, 3) rotation, degrees; accurate for small angles too."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = R.tolist()
    sine = math.hypot(r21 - r12, r02 - r20, r10 - r01)
    return math.degrees(math.atan2(sine, r00 + r11 + r22 - 1.0))


def pose_difference(one: Array, two: Array) -> tuple[float, float]:
    """Between two T_camera_lidar: the angle [deg] and the distance of the camera centres [cm]."""
    meters = math.hypot(*(camera_center(one) - camera_center(two)).tolist())
    return angle_deg(one[:3, :3] @ two[:3, :3].T), 100 * meters


def twist_between(T_camera_lidar: Array, reference: Array) -> Array:
    """(6,) xi, rotation [rad] and translation [m], in T_camera_lidar = exp(xi) reference."""
    step = gtsam.Pose3(relative_transform(T_camera_lidar, reference))
    return np.asarray(gtsam.Pose3.Logmap(step))


def twists_between(T_a_b: Array, references: Array) -> Array:
    """(f, 6) xi, rotation [rad] and translation [m], in T_a_b = exp(xi) reference.

    Args:
        T_a_b: (f, 4, 4).
        references: (4, 4) or (f, 4, 4).
    """
    twists: Array = logarithms(relative_transform(T_a_b, references))
    return twists


def pose_rows(camera: int) -> slice:
    """The six rows of camera number ``camera`` in a joint vector or matrix of all cameras."""
    return slice(6 * camera, 6 * camera + 6)


def rows_of_poses(names: Sequence[str], order: Sequence[str]) -> NDArray[np.int64]:
    """(6 n,) rows of named poses in a covariance of poses in an order."""
    rows = [np.r_[pose_rows(order.index(name))] for name in names]
    return np.array(rows, np.int64).ravel()


def relative_covariance(joint: Array, a: int, b: int, T_b_a: Array) -> Array:
    """(6, 6) covariance of xi in T_b_a = exp(xi) estimate, xi in b's axes.

    Args:
        joint: (6 N, 6 N) of all cameras.
        a: index of the one camera.
        b: index of the other camera.
        T_b_a: the estimate, T_b_lidar T_a_lidar^-1.
    """
    # T_b_a = exp(xi_b) T_b (exp(xi_a) T_a)^-1 = exp(xi_b) exp(-Ad(T_b_a) xi_a) T_b_a.
    jacobian = np.zeros((6, len(joint)))
    jacobian[:, pose_rows(a)] = -gtsam.Pose3(T_b_a).AdjointMap()
    jacobian[:, pose_rows(b)] = np.eye(6)
    covariance: Array = jacobian @ joint @ jacobian.T
    return covariance


def adjoints(T_a_b: Array) -> Array:
    """(f, 6, 6) Ad(T_a_b) of (f, 4, 4): twists in b, rotation first, to the same in a."""
    R, crosses = T_a_b[:, :3, :3], np.zeros((len(T_a_b), 3, 3))
    crosses[:, 2, 1], crosses[:, 0, 2], crosses[:, 1, 0] = x, y, z = T_a_b[:, :3, 3].T
    crosses[:, 1, 2], crosses[:, 2, 0], crosses[:, 0, 1] = -x, -y, -z
    Ad = np.zeros((len(R), 6, 6))
    Ad[:, :3, :3] = Ad[:, 3:, 3:] = R
    Ad[:, 3:, :3] = crosses @ R
    return Ad


def retract_all(T_camera_lidar: Array, steps: Array) -> Array:
    """(f, 4, 4) T_camera_lidar of the variables moved by their tangents.

    As GTSAM's ``retract``, of many at once: T_lidar_camera exp(step).

    Args:
        T_camera_lidar: (f, 4, 4).
        steps: (f, 6) tangents of T_lidar_camera: rotation [rad], translation [m].
    """
    moved = np.array(T_camera_lidar, order="C")
    exponential_times(np.ascontiguousarray(-steps), moved)
    return moved


def local_coordinates(T_camera_lidar: Array, T_lidar_camera: Array) -> Array:
    """(f, 6) tangents from one variable to others, as GTSAM's ``localCoordinates``.

    From a (4, 4), which is inverted, to (f, 4, 4).
    """
    tangents: Array = logarithms(T_camera_lidar @ T_lidar_camera)
    return tangents


def degrees_and_centimetres(covariance: Array) -> tuple[Array, Array]:
    """The standard deviations of a (6, 6): (3,) rotation [deg], (3,) translation [cm]."""
    sigmas = np.sqrt(np.diag(covariance))
    return np.degrees(sigmas[:3]), sigmas[3:] * 100.0


def pair_covariances(
    joint: Array | None, T_camera_lidar: Mapping[str, Array], without: Container[str] = ()
) -> dict[str, Array]:
    """Per pair "A->B", (6, 6) of xi in T_B_A = exp(xi) estimate; of none without a covariance.

    Args:
        joint: (6 N, 6 N) of all cameras.
        T_camera_lidar: (4, 4) of each.
        without: cameras that have no error bar.
    """
    if joint is None:
        return {}
    T = T_camera_lidar
    return {
        f"{a}->{b}": relative_covariance(joint, i, j, relative_transform(T[b], T[a]))
        for (i, a), (j, b) in combinations(enumerate(T), 2)
        if a not in without and b not in without
    }

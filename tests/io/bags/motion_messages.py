"""Messages of a moving vehicle."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from calibgraph import load_rig
from calibgraph.model.geometry import invert
from tests.conftest import SAMPLE
from tests.io.bags.writing import (
    PERIOD_NS,
    START_NS,
    Messages,
    Stamped,
    tree_of,
)

RIG = load_rig(SAMPLE)


MAKE = Messages("mcap")


TWIST = np.array([0.0, 0.0, 0.3, 10.0, 0.0, 0.0])  # of base: 36 km/h along a bend


T_BASE_LIDAR = tree_of(RIG)[0][2]


IMAGE_S = 0.04  # after the start of the scan


FRAMES = 4


def T_world_lidar(seconds: float) -> np.ndarray:
    T_world_base = gtsam.Pose3.Expmap(TWIST * seconds).matrix()
    return np.asarray(T_world_base @ T_BASE_LIDAR)


def world_to_base(seconds: np.ndarray) -> np.ndarray:
    """(n, 4, 4) inverses of the exponential of TWIST: an arc about z."""
    turn, speed = TWIST[2], TWIST[3]
    cos, sin = np.cos(turn * seconds), np.sin(turn * seconds)
    T = np.tile(np.eye(4), (len(seconds), 1, 1))
    T[:, 0, 0], T[:, 0, 1], T[:, 0, 3] = cos, sin, -speed / turn * sin
    T[:, 1, 0], T[:, 1, 1], T[:, 1, 3] = -sin, cos, speed / turn * (1 - cos)
    return T


def world(seed: int, count: int = 12_000) -> np.ndarray:
    """(n, 3) a road between walls and boxes; other points of the same surfaces with each seed."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-30, 40, (2, count)), rng.uniform(0, 4, count)
    ground = np.column_stack([u[0], u[1], 0.0 * v])
    walls = [np.column_stack([u[0], side + 0.0 * v, v]) for side in (-9.0, 14.0)] + [
        np.column_stack([far + 0.0 * v, u[1], v]) for far in (-25.0, 35.0)
    ]
    boxes = [
        np.column_stack([x + 2 * np.sign(np.sin(u[0])), y + u[1] % 3, v])
        for x, y in ((5, -6), (12, 8), (-8, 5), (20, -4), (-14, -7))
    ]
    return np.concatenate([ground, *walls, *boxes])[rng.permutation(10 * count)[: 2 * count]]


def scan(start_s: float, points: np.ndarray) -> np.ndarray:
    """(n,) points that are taken one after another in 0.1 s, as a LiDAR turns."""
    times = np.linspace(0, 0.1, len(points))
    T_base_world = world_to_base(start_s + times)
    in_base = np.einsum("nij,nj->ni", T_base_world[:, :3, :3], points) + T_base_world[:, :3, 3]
    T_lidar_base = invert(T_BASE_LIDAR)
    seen = in_base @ T_lidar_base[:3, :3].T + T_lidar_base[:3, 3]
    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")]
    rows = np.zeros(len(points), kind)
    rows["x"], rows["y"], rows["z"] = seen.T
    rows["t"] = np.rint(times * 1e9)
    return rows


def messages(*, timed: bool = True) -> tuple[list[Stamped], list[np.ndarray]]:
    """The messages, and per frame the points of the world."""
    written = [
        Stamped("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, MAKE.transforms(tree_of(RIG)))
    ]
    worlds = []
    for name, camera in RIG.cameras.items():
        info = MAKE.camera_info(camera, f"{name}_optical")
        written.append(
            Stamped(f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", START_NS, info)
        )
    for number in range(FRAMES):
        stamp_ns = START_NS + number * PERIOD_NS
        worlds.append(world(number))
        rows = scan(number * PERIOD_NS / 1e9, worlds[-1])
        rows["t"] *= timed
        cloud = MAKE.cloud(rows, stamp_ns)
        written.append(Stamped("/points", "sensor_msgs/msg/PointCloud2", stamp_ns, cloud))
        for name in RIG.cameras:
            image = MAKE.image(np.zeros((4, 6), np.uint8), "mono8", stamp_ns + int(IMAGE_S * 1e9))
            written.append(Stamped(f"/{name}/image_raw", "sensor_msgs/msg/Image", stamp_ns, image))
    for tick in range(-10, 60):  # 50 Hz
        stamp_ns, T = START_NS + tick * 20_000_000, gtsam.Pose3.Expmap(TWIST * tick * 0.02).matrix()
        moving = MAKE.transforms([("odom", "base", T)])
        moving.transforms[0].header.stamp = MAKE.header(stamp_ns, "").stamp
        elsewhere = MAKE.transforms([("map", "odom", np.eye(4))]).transforms
        moving.transforms.extend(elsewhere)
        written.append(Stamped("/tf", "tf2_msgs/msg/TFMessage", stamp_ns, moving))
        odometry = odometry_of(moving.transforms[0])
        written.append(Stamped("/odom", "nav_msgs/msg/Odometry", stamp_ns, odometry))
    return sorted(written, key=lambda each: each.record_ns), worlds


def odometry_of(stamped: Any) -> Any:
    t, q = stamped.transform.translation, stamped.transform.rotation
    point = MAKE.make("geometry_msgs/msg/Point", x=t.x, y=t.y, z=t.z)
    pose = MAKE.make("geometry_msgs/msg/Pose", position=point, orientation=q)
    zero = MAKE.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = MAKE.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    none = np.zeros(36)
    return MAKE.make(
        "nav_msgs/msg/Odometry", header=stamped.header, child_frame_id="base",
        pose=MAKE.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=none),
        twist=MAKE.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
    )  # fmt: skip

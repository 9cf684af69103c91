"""Scans of a moving vehicle."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from calibgraph import BagOptions, DatasetError, load_dataset, load_rig
from calibgraph.io.bags.point_clouds import points_of
from calibgraph.io.frame import frame_of_entry
from calibgraph.matching import places
from calibgraph.model.geometry import invert
from calibgraph.trust.inputs import find_doubts
from tests.conftest import SAMPLE
from tests.io.bags.writing import PERIOD_NS, START_NS, Messages, Stamped, tree_of, write_bag

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


def messages(
    *, timed: bool = True, late_s: Mapping[str, float] | None = None
) -> tuple[list[Stamped], list[np.ndarray]]:
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
            taken_ns = stamp_ns + round(1e9 * (IMAGE_S + (late_s or {}).get(name, 0.0)))
            image = MAKE.image(np.zeros((4, 6), np.uint8), "mono8", taken_ns)
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


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[np.ndarray]]:
    written, worlds = messages()
    return write_bag(tmp_path_factory.mktemp("moving"), "mcap", written), worlds


def errors_m(bag: tuple[Path, list[np.ndarray]], motion: Any) -> list[float]:
    """Root mean square per frame, against the points as seen when the images were taken."""
    data = load_dataset(bag[0], bag=BagOptions(motion=motion))
    found = []
    for number, (frame, points) in enumerate(zip(data.frames, bag[1], strict=True)):
        inverse = invert(T_world_lidar(number * PERIOD_NS / 1e9 + IMAGE_S))
        expected = points @ inverse[:3, :3].T + inverse[:3, 3]
        cloud = frame.load_cloud()
        np.testing.assert_array_equal(cloud, frame_of_entry(frame.entry()).load_cloud())
        found.append(float(np.sqrt(np.mean((cloud[:, :3] - expected) ** 2 * 3))))
    return found


@pytest.mark.parametrize(
    ("motion", "least_m", "most_m"),
    [
        ("none", 0.25, np.inf),
        ("odometry", 0.0, 2e-4),  # on the bend: 10 m/s 0.3 /s (20 ms)^2 / 8
        ("tf", 0.0, 2e-4),
        ("scans", 0.0, 0.01),  # surfaces without noise, in voxels of 0.25 m
    ],
)
def test_scans_of_a_moving_vehicle_are_corrected_by_poses_and_by_their_neighbours(
    bag: tuple[Path, list[np.ndarray]], motion: str, least_m: float, most_m: float
) -> None:
    found = errors_m(bag, motion)
    assert least_m <= min(found) and max(found) < most_m


def test_a_motion_that_is_not_corrected_is_noted(bag: tuple[Path, list[np.ndarray]]) -> None:
    (note,) = [n for n in load_dataset(bag[0]).notes if "points have a t" in n]
    assert note.endswith("give --motion odometry, tf or scans, or stand still")


@pytest.mark.parametrize(("motion", "limit_m"), [("odometry", 2e-4), ("scans", 0.1)])
def test_poses_or_twists_give_the_motion_between_frames(
    bag: tuple[Path, list[np.ndarray]], monkeypatch: pytest.MonkeyPatch, motion: Any, limit_m: float
) -> None:
    """No feature is looked for; scans give twists alone, which hold for a short time.

    Of poses, the limit is that of their interpolation; of scans, a tenth of the step.
    """
    data = load_dataset(bag[0], bag=BagOptions(motion=motion))
    monkeypatch.setattr(places, "_detect", lambda *_, **__: None)
    name, lens = next(iter(RIG.cameras.items()))
    period_s = PERIOD_NS / 1e9
    for number, step in enumerate(places.motions(data, name, lens)):
        assert step is not None
        now, before = T_world_lidar((number + 1) * period_s), T_world_lidar(number * period_s)
        expected = invert(now) @ before
        assert np.linalg.norm(expected[:3, 3]) > 0.9
        assert np.linalg.norm(step[:3, 3] - expected[:3, 3]) < limit_m
    monkeypatch.setattr(places, "MOST_S", 0.5 * period_s)
    found = places.motions(data, name, lens)
    assert [step is None for step in found] == [motion == "scans"] * len(found)


def test_stamps_tell_when_each_camera_takes_its_image(tmp_path: Path) -> None:
    """As of cameras that are triggered where the LiDAR looks; what the rig states is left alone."""
    first, *_, last = RIG.cameras
    path = write_bag(tmp_path, "mcap", messages(late_s={first: -0.02, last: 0.005})[0])
    data = load_dataset(path, bag=BagOptions(motion="odometry"))
    found = {name: camera.time_offset_s for name, camera in data.rig.cameras.items()}
    assert found.pop(first) == pytest.approx(-0.02)
    assert found.pop(last) == pytest.approx(0.005)
    assert [*found.values()] == [None]
    assert any(f"{first} -20.0 ms" in note and f"{last} +5.0 ms" in note for note in data.notes)
    known = RIG.cameras[first].model_copy(update={"time_offset_s": 0.001})
    stated = RIG.model_copy(update={"cameras": {**RIG.cameras, first: known}})
    again = load_dataset(path, stated, bag=BagOptions(motion="odometry")).rig.cameras
    assert again[first].time_offset_s == 0.001  # noqa: RUF069
    swept = load_dataset(path)
    assert swept.rig.cameras[last].time_offset_s is None
    after_s = [swept.frames[1].image_after_s(name) for name in (first, last)]
    assert after_s == [pytest.approx(IMAGE_S - 0.02), pytest.approx(IMAGE_S + 0.005)]
    found = swept.frames[1].load_sweep()
    assert found is not None
    assert (found[1].min(), found[1].max()) == (0.0, pytest.approx(0.1))


def test_times_that_are_all_equal_are_named_if_motion_is_to_be_corrected(
    bag: tuple[Path, list[np.ndarray]], tmp_path: Path
) -> None:
    equal = write_bag(tmp_path / "equal", "mcap", messages(timed=False)[0])
    for path, motion, expected in ((equal, "tf", 1), (equal, "none", 0), (bag[0], "tf", 0)):
        frame = load_dataset(path, bag=BagOptions(motion=motion)).frames[1]  # type: ignore[arg-type]
        found = [text for text in find_doubts(RIG, frame, frame.load_cloud()) if "time" in text]
        assert len(found) == expected
        assert all("so that --motion moves it as a whole" in text for text in found)


def test_clouds_of_an_instant_are_moved_as_a_whole(
    bag: tuple[Path, list[np.ndarray]], tmp_path: Path
) -> None:
    equal = write_bag(tmp_path / "equal", "mcap", messages(timed=False)[0])
    whole, stated = (load_dataset(path, bag=BagOptions(motion="tf")) for path in (equal, bag[0]))
    frame = stated.at_instants().frames[1]
    assert frame.load_sweep() is None
    for each in (frame, frame_of_entry(frame.entry())):
        np.testing.assert_array_equal(each.load_cloud(), whole.frames[1].load_cloud())


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("<u4", [0, 50_000_000]),
        ("<f4", [0.0, 0.05]),
        ("<f8", [START_NS / 1e9, START_NS / 1e9 + 0.05]),
        ("<f8", [float(START_NS), START_NS + 5e7]),
    ],
)
def test_times_of_all_drivers_are_read(kind: str, values: list[float]) -> None:
    rows = np.ones(2, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", kind)])
    rows["timestamp"] = values
    _, times = points_of(MAKE.cloud(rows, START_NS), "here", timed=True)
    np.testing.assert_allclose(times, [0.0, 0.05], atol=1e-6)  # float64 stamps: 0.2 us


def test_times_that_are_none_are_refused() -> None:
    rows = np.ones(2, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4")])
    rows["time"] = 7.0, np.nan
    with pytest.raises(DatasetError, match="time: times from .* are not those of one scan"):
        points_of(MAKE.cloud(rows, START_NS), "here", timed=True)

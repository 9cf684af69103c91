"""The simulated sensors: what they measure is where the truth says it is."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibgraph import CalibrationError, Camera, Intrinsics, Rig, load_dataset, load_rig
from calibgraph.model.geometry import angle_deg
from calibgraph.simulation.cameras import Imaging, camera_rays, light, pixel_directions, render
from calibgraph.simulation.lidar import (
    lidar_of,
    return_chance,
    ring_gains,
    scan,
    shot_directions,
)
from calibgraph.simulation.mesh import mesh_of, mesh_of_solid
from calibgraph.simulation.recording import Drive, simulate_street, street_drive
from calibgraph.simulation.rigs import RIG_NAMES, rig_of
from calibgraph.simulation.solids import Solid, box, cylinder, ellipsoid
from calibgraph.simulation.world import albedos, build_world, cast
from tests.conftest import FORWARD, KANNALA, RADTAN5, Call

pytest.importorskip(
    "open3d", reason="open3d or a system library of it is missing", exc_type=ImportError
)

LENSES = {"pinhole": (), "radtan": RADTAN5, "fisheye": KANNALA}
SCAN = replace(lidar_of(16), azimuth_step_deg=1.0)
DRIVE_SEED = 3


def small_camera(lens: str, position_m: tuple[float, float, float] = (0.3, 0.2, -0.3)) -> Camera:
    T = np.eye(4)
    T[:3, :3] = FORWARD
    T[:3, 3] = -FORWARD @ position_m
    is_fisheye = lens == "fisheye"
    focal = 62.0 if is_fisheye else 150.0  # 120 px from the centre: 107 or 39 degrees
    return Camera(
        model="fisheye" if is_fisheye else "pinhole",
        width_px=240,
        height_px=150,
        intrinsics_px=Intrinsics(fx=focal, fy=focal + 1, cx=121.3, cy=73.8),
        distortion=LENSES[lens],
        T_camera_lidar=T,
    )


@pytest.fixture(scope="module")
def drive() -> Drive:
    return street_drive(frames=3, seed=DRIVE_SEED)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig(cameras={name: small_camera(name) for name in ("radtan", "fisheye")})


@pytest.fixture(scope="module")
def recording(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "street"
    simulate_street(folder, rig, beams=16, frames=2, seed=5, rotation_deg=3, translation_m=0.2)
    return folder


def noiseless(drive: Drive, frame: int, directions: np.ndarray) -> np.ndarray:
    """Ranges along directions in the LiDAR's frame."""
    T = drive.T_world_lidar[frame]
    rays = (directions @ T[:3, :3].T).astype(np.float32)
    return cast(drive.world, T[:3, 3], rays).distance_m


def shots_of(points: np.ndarray) -> np.ndarray:
    """Which shot each point of a scan was."""
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) + 180
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    steps = round(360 / SCAN.azimuth_step_deg)
    column = np.rint(azimuth / SCAN.azimuth_step_deg).astype(int) % steps
    top, bottom = SCAN.elevations_deg[0], SCAN.elevations_deg[-1]
    ring = np.rint((top - elevation) / (top - bottom) * (len(SCAN.elevations_deg) - 1))
    return ring.astype(int) * steps + column


@pytest.mark.parametrize("lens", LENSES)
def test_camera_and_lidar_see_the_same_surfaces(drive: Drive, lens: str) -> None:
    camera = small_camera(lens)
    T_world_camera = drive.T_world_lidar[1] @ np.linalg.inv(camera.T_camera_lidar)
    exact = replace(SCAN, range_noise_m=0.0)
    cloud = scan(drive.world, exact, np.ones(16), drive.T_world_lidar[1], np.random.default_rng(0))
    points = cloud[:, :3] @ camera.T_camera_lidar[:3, :3].T + camera.T_camera_lidar[:3, 3]
    pixels, valid = camera.lens.project(points)
    seen = valid & camera.in_image(pixels)
    rays = pixel_directions(camera, pixels[seen])
    looking = rays.any(axis=1)  # within the fisheye's field
    outwards = (rays @ T_world_camera[:3, :3].T).astype(np.float32)
    depth = cast(drive.world, T_world_camera[:3, 3], outwards).distance_m[looking]
    behind = depth - np.linalg.norm(points[seen], axis=1)[looking]
    # Rays are float32, 6e-8 of 100 m, and inverted to 1e-6 px of 1/62 rad: along a surface that is
    # met at 1 degree that is 60 times 2e-6 m. Points may be hidden from the camera, which stands
    # apart from the LiDAR; but none is seen through, but for some just at an edge.
    assert np.count_nonzero(looking) > 300
    assert np.mean(np.abs(behind) < 1e-3) > 0.85
    assert np.mean(behind > 1e-3) < 0.01


@pytest.mark.parametrize(
    ("lens", "place_m"),
    [
        ("pinhole", (6.0, 2.0, 1.0)),
        ("radtan", (6.0, -4.2, -1.8)),
        ("radtan", (5.0, 3.2, 0.3)),
        ("fisheye", (4.0, 3.0, -1.0)),
        ("fisheye", (0.15, -4.0, -0.2)),  # 92 degrees off the axis
    ],
)
def test_a_ball_is_where_the_lens_projects_it(lens: str, place_m: tuple[float, ...]) -> None:
    camera = small_camera(lens)
    size = 0.04 * float(np.linalg.norm(place_m))
    rays, rng, sun = camera_rays(camera), np.random.default_rng(0), np.array([0.0, 0.0, 1.0])
    x, y, z = place_m
    black = (0.0, 0.0, 0.0, 0.0)
    ball = ellipsoid((x, y, z - size / 2), (size, size, size), black)
    far = ellipsoid((-900.0, 0.0, 900.0), (1.0, 1.0, 1.0), black)
    T_world_camera = np.linalg.inv(camera.T_camera_lidar)
    empty, full = (
        light(build_world(mesh_of(map(mesh_of_solid, solids)), sun, rng), rays, T_world_camera)
        for solids in ((far,), (far, ball))
    )
    covered = np.maximum(empty - full, 0).sum(axis=2)
    v, u = (np.average(index, weights=covered) for index in np.indices(covered.shape))
    centre = camera.T_camera_lidar[:3, :3] @ place_m + camera.T_camera_lidar[:3, 3]
    expected = camera.lens.project(centre[None])[0][0]
    # A ball of angular radius r, at t off the axis, is an ellipse about f tan(t) (1 + tan(t)^2) r^2
    # from its centre's image: at most 150 * 0.8 * 1.6 * 0.02^2 = 0.08 px. Its 20 rim pixels are
    # covered by quarters: 0.02 px. Half a pixel's shift of the grid shows.
    assert np.count_nonzero(covered) > 5
    assert np.allclose([u, v], expected, atol=0.12)


def test_fisheye_is_black_just_beyond_95_degrees() -> None:
    camera = small_camera("fisheye")
    angles = np.radians([94.9, 95.1])
    turn = np.radians([0.0, 180.0])  # to both sides, where the image is wide enough
    rays = np.array([[np.sin(a) * np.cos(t), 0.0, np.cos(a)] for a in angles for t in turn])
    pixels, valid = camera.lens.project(rays)
    assert valid.all()
    found = pixel_directions(camera, pixels)
    assert np.allclose(found[:2], rays[:2], atol=1e-6)
    assert not found[2:].any()


@pytest.mark.parametrize("name", RIG_NAMES)
def test_every_pixel_of_the_pinhole_rigs_sees(name: str) -> None:
    for camera in rig_of(name).cameras.values():
        w, h = camera.width_px - 0.5, camera.height_px - 0.5
        corners = np.array([[-0.5, -0.5], [w, -0.5], [-0.5, h], [w, h], [w / 2, h / 2]])
        seen = pixel_directions(camera, corners).any(axis=1)
        assert seen.tolist() == [camera.model == "pinhole"] * 4 + [True]


def test_range_noise_and_dropouts_are_those_asked_for(drive: Drive) -> None:
    T, shots = drive.T_world_lidar[0], shot_directions(SCAN)
    cloud = scan(drive.world, SCAN, np.ones(16), T, np.random.default_rng(1))
    truth, index = noiseless(drive, 0, shots), shots_of(cloud)
    error = np.linalg.norm(cloud[:, :3], axis=1) - truth[index]
    sigma, n = SCAN.range_noise_m, len(cloud)
    assert abs(error.mean()) < 4 * sigma / np.sqrt(n)
    assert abs(error.std() - sigma) < 4 * sigma / np.sqrt(2 * n)
    directions = (shots @ T[:3, :3].T).astype(np.float32)
    albedo, incidence = albedos(drive.world, directions, cast(drive.world, T[:3, 3], directions))
    within = (truth > SCAN.min_range_m) & (truth < SCAN.max_range_m)
    chance = np.where(within, return_chance(SCAN, albedo[:, 3] * incidence, truth), 0.0)
    # Noise moves shots across the limits of the range, and changes the chance by 1e-3 or so.
    assert abs(n - chance.sum()) < 4 * np.sqrt((chance * (1 - chance)).sum()) + 1e-3 * n


@pytest.mark.parametrize("make", [box, cylinder, ellipsoid])
def test_meshes_have_the_size_of_their_solids(make: Callable[..., Solid]) -> None:
    solid = replace(make((3.0, -2.0, 1.0), (4.0, 2.0, 2.0), (0.5,) * 4), yaw_deg=90.0)
    corners = mesh_of_solid(solid).corners_m.reshape(-1, 3)
    # A quarter turn lays its x axis along y. Round ones touch their extents at corners.
    assert np.allclose(corners.min(axis=0), [2.0, -4.0, 1.0], atol=1e-12)
    assert np.allclose(corners.max(axis=0), [4.0, 0.0, 3.0], atol=1e-12)
    a, b, c = (mesh_of_solid(solid).corners_m - [3.0, -2.0, 2.0]).swapaxes(0, 1)
    volume = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c))).sum() / 6  # convex: cones add up
    exact = 16 * {"box": 1, "cylinder": np.pi / 4, "ellipsoid": np.pi / 6}[make.__name__]
    # Inscribed: 20 sides hold 20 / 2 pi sin(2 pi / 20) = 0.984 of a disc. The facets of a ball span
    # 90 / 8 degrees, so none is nearer than cos(11.25 deg) to the middle: 0.98^3 = 0.94 of it.
    assert 0.94 * exact < volume <= exact * (1 + 1e-12)


def test_far_dark_and_slanted_surfaces_return_less() -> None:
    lidar = lidar_of(64)
    near, far = return_chance(lidar, np.array([0.1, 0.1]), np.array([10.0, 80.0]))
    bright, dark = return_chance(lidar, np.array([0.8, 0.02]), np.array([60.0, 60.0]))
    assert near == pytest.approx(1 - lidar.dropout, abs=1e-6)
    assert far < 0.95 < bright
    assert dark < 0.7


def test_rings_keep_their_gains(drive: Drive) -> None:
    gains = ring_gains(SCAN, np.random.default_rng(2))
    plain = replace(SCAN, range_noise_m=0.0, intensity_noise=0.0)
    T = drive.T_world_lidar[0]
    alike, ringed = (scan(drive.world, plain, g, T, np.random.default_rng(0))
                     for g in (np.ones(16), gains))  # fmt: skip
    ring = shots_of(alike) // 360
    unsaturated = (ringed[:, 3] > 0) & (ringed[:, 3] < 1) & (alike[:, 3] < 1)
    ratio = ringed[unsaturated, 3] / alike[unsaturated, 3]
    assert np.allclose(ratio, gains[ring[unsaturated]], rtol=1e-5)


def test_image_noise_is_that_asked_for(drive: Drive) -> None:
    camera = small_camera("pinhole")
    rays, T = camera_rays(camera), drive.T_world_lidar[0] @ np.linalg.inv(camera.T_camera_lidar)
    clean, first, second = (
        render(drive.world, rays, T, rng, Imaging(noise=noise, exposure_spread=0.0)).astype(float)
        for noise, rng in zip((0.0, 0.02, 0.02), np.random.default_rng(1).spawn(3), strict=True)
    )
    inside = (clean > 25) & (clean < 230)  # 5 sigma from black and white
    difference = (first - second)[inside]
    expected = np.sqrt(2 * ((255 * 0.02) ** 2 + 1 / 12))  # with the rounding to whole levels
    assert len(difference) > 10_000
    assert abs(difference.std() / expected - 1) < 4 / np.sqrt(2 * len(difference))


def test_stops_are_apart_and_no_car_stands_in_them() -> None:
    drive = street_drive(frames=6, step_m=5.0, seed=1)
    places = np.array([T[:3, 3] for T in drive.T_world_lidar])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    # Along the line 5 m +- 15 %; across, each stop sways by 0.25 m, which adds under 5 %.
    assert steps.min() > 0.8 * 5.0
    assert steps.max() < 1.25 * 5.0
    for T in drive.T_world_lidar:
        cloud = scan(drive.world, SCAN, np.ones(16), T, np.random.default_rng(0))
        x, y, z = cloud[:, :3].T
        assert not np.any((np.abs(x) < 2.5) & (np.abs(y) < 1.0) & (z > -1.4))


def test_a_recording_is_a_dataset_with_its_truth(recording: Path, rig: Rig) -> None:
    data, truth = load_dataset(recording), load_rig(recording / "reference.yaml")
    assert [frame.name for frame in data.frames] == ["000000", "000001"]
    for name, camera in truth.cameras.items():
        assert np.allclose(camera.T_camera_lidar, rig.cameras[name].T_camera_lidar, atol=1e-12)
        off = data.rig.cameras[name].T_camera_lidar @ np.linalg.inv(camera.T_camera_lidar)
        assert angle_deg(off[:3, :3]) == pytest.approx(3.0)
        image = data.frames[1].load_image(name, camera)
        assert image.std() > 20  # levels: there is something to see
    cloud = data.frames[1].load_cloud()
    assert cloud.shape[1] == 4
    assert 0.5 * 16 * 1800 < len(cloud) < 16 * 1800
    assert cloud[:, 3].min() >= 0
    assert cloud[:, 3].max() <= 1


def test_the_same_seed_gives_the_same_files(recording: Path, rig: Rig, tmp_path: Path) -> None:
    again, other = tmp_path / "again", tmp_path / "other"
    simulate_street(again, rig, beams=16, frames=2, seed=5, rotation_deg=3, translation_m=0.2)
    simulate_street(other, rig, beams=16, frames=2, seed=6, rotation_deg=3, translation_m=0.2)
    files = sorted(p.relative_to(recording) for p in recording.rglob("*") if p.is_file())
    assert len(files) == 2 + 2 + 2 * 2
    for file in files:
        assert (again / file).read_bytes() == (recording / file).read_bytes()
        same = (other / file).read_bytes() == (recording / file).read_bytes()
        assert same == (file.name == "reference.yaml")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"beams": 33}, "33 beams"),
        ({"frames": 0}, "0 frames"),
        ({"step_m": -1.0}, "-1.0 m apart"),
        ({"step_m": float("nan")}, "nan m apart"),
        ({"frames": 1000}, "1000 frames, 4.0 m apart"),
        ({"rotation_deg": -1.0}, "-1.0 deg"),
    ],
)
def test_bad_arguments_are_refused(
    rig: Rig, tmp_path: Path, changed: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        simulate_street(tmp_path / "out", rig, **changed)
    assert not (tmp_path / "out").exists()


def test_missing_open3d_says_how_to_install_it(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(CalibrationError, match=r"pip install 'calibgraph\[pointcloud\]'"):
        simulate_street(tmp_path / "out", rig, frames=1)


def test_command_writes_a_dataset_and_none_over_it(call: Call, rig: Rig, tmp_path: Path) -> None:
    rig.save(tmp_path / "own.yaml")
    options = "--rig", tmp_path / "own.yaml", "--frames", 1, "--beams", 16
    code, _, errors = call("simulate", "street", *options, "--out", tmp_path / "made")
    assert (code, "rig.yaml: written" in errors) == (0, True)
    assert len(load_dataset(tmp_path / "made").frames) == 1
    code, _, errors = call("simulate", "street", *options, "--out", tmp_path / "made")
    assert code == 2
    assert "is there already" in errors


def test_nothing_is_left_of_a_recording_that_fails(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*arguments: object, **options: object) -> None:
        raise MemoryError

    monkeypatch.setattr("calibgraph.simulation.recording.render", fails)
    with pytest.raises(MemoryError):
        simulate_street(tmp_path / "out", rig, frames=1, beams=16)
    assert not list((tmp_path / "out").iterdir())


def test_images_too_large_to_write_are_refused(rig: Rig, tmp_path: Path) -> None:
    name, camera = next(iter(rig.cameras.items()))
    values = {**camera.model_dump(), "width_px": 70_000}
    with pytest.raises(ValueError, match="70000x"):
        simulate_street(tmp_path / "out", Rig(cameras={name: Camera(**values)}), frames=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("street", "--rig", "nosuch"), "known are kitti, walkley, surround, fisheye, sample"),
        (("nowhere",), "unknown scenario 'nowhere'; known are street"),
        (("street", "--beams", 3), "3 beams"),
    ],
)
def test_command_refuses_in_one_line(
    call: Call, tmp_path: Path, arguments: tuple[object, ...], message: str
) -> None:
    code, _, errors = call("simulate", *arguments, "--out", tmp_path / "out")
    assert code == 2
    assert message in errors
    assert errors.count("\n") == 1

"""The prior of a new vehicle: its sigmas are those of vehicles that were not seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibgraph import Rig, load_rig
from calibgraph.errors import RigError
from calibgraph.fleet.model import FleetModel, fit_fleet
from calibgraph.fleet.model_files import expected_pose, prior_rig, write_fleet_model
from calibgraph.fleet.observations import observe
from calibgraph.model.geometry import relative_transform, twists_between
from calibgraph.simulation.rigs import rig_of
from tests.draws.fleets import CAMERAS, Fleet, simulate_fleet


@pytest.fixture(scope="module")
def halves() -> tuple[Fleet, FleetModel]:
    """A fleet without moved cameras; its model knows every second vehicle."""
    truth = simulate_fleet(np.random.default_rng(6), 600, moved_share=0.0, change_deg=0.0)
    seen = observe(truth.rows).select(np.arange(len(truth.rows)) // 6 % 2 == 0)
    return truth, fit_fleet(seen)


def unseen(truth: Fleet, model: str, camera: str) -> np.ndarray:
    of = observe(truth.rows)
    odd = np.arange(len(truth.rows)) // 6 % 2 == 1
    return truth.T_camera_lidar[odd & (of.model == model) & (of.camera == camera)]


def test_covariances_of_a_new_vehicle_hold(halves: tuple[Fleet, FleetModel]) -> None:
    """Of 150 vehicles with 6 axes the mean has a standard deviation of 5 %."""
    truth, fleet = halves
    for name, model in fleet.models.items():
        for camera, mount in model.mounts.items():
            T, covariance = expected_pose(mount, model.pooled)
            xi = twists_between(unseen(truth, name, camera), T)
            nees = np.einsum("ni,ij,nj->n", xi, np.linalg.inv(covariance), xi) / 6
            assert 0.8 < nees.mean() < 1.25


def test_relative_poses_hold_along_their_widest_axis(halves: tuple[Fleet, FleetModel]) -> None:
    truth, fleet = halves
    rig = prior_rig(rig_of_six(), fleet.models["van"])
    assert [(pair.a, pair.b) for pair in rig.relative_poses] == [
        (CAMERAS[0], name) for name in CAMERAS[1:]
    ]
    for pair in rig.relative_poses:
        T_b_a = relative_transform(unseen(truth, "van", pair.b), unseen(truth, "van", pair.a))
        xi = twists_between(T_b_a @ pair.T_a_b, np.eye(4))  # in the axes of b
        for axes, sigma in (
            (xi[:, :3], pair.rotation_sigma_rad), (xi[:, 3:], pair.translation_sigma_m)
        ):  # fmt: skip
            widest = np.sqrt(np.linalg.eigvalsh(axes.T @ axes / len(axes))[-1])
            assert 0.75 < widest / sigma < 1.25


def rig_of_six() -> Rig:
    rig = rig_of("surround")
    return rig.model_copy(update={"cameras": dict(zip(CAMERAS, rig.cameras.values(), strict=True))})


def test_files_can_be_read_again(halves: tuple[Fleet, FleetModel], tmp_path: Path) -> None:
    fleet = halves[1]
    paths = write_fleet_model(fleet, tmp_path, {"van": rig_of_six()})
    assert sorted(path.name for path in paths) == sorted(path.name for path in tmp_path.iterdir())
    rig = load_rig(tmp_path / "prior_van.yaml")
    nominal = fleet.models["van"].mounts["left"].centers.nominal
    assert np.allclose(rig.T_camera_lidar["left"], nominal, rtol=0, atol=1e-12)
    assert (tmp_path / "prior_van_B03.yaml").is_file()


def test_a_rig_with_another_camera_is_refused(halves: tuple[Fleet, FleetModel]) -> None:
    with pytest.raises(RigError, match="is not among the fleet's front, front_left"):
        prior_rig(rig_of("kitti"), halves[1].models["van"])

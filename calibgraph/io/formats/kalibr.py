"""Kalibr's camchain YAML, with T_cam_lidar as further key of a camera."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model
from calibgraph.io.formats.documents import commented_yaml
from calibgraph.io.formats.part import IMU, FrameLink, Part, RelativeCamera
from calibgraph.io.formats.rig_export import (
    COVARIANCE_SENTENCE,
    RigExport,
    carried_coefficients,
    no_place_for,
)
from calibgraph.io.lenses import (
    CameraLens,
    listed_coefficients,
    listed_intrinsics,
    stated_model,
    unified_coefficients,
)
from calibgraph.model.geometry import invert, relative_transform
from calibgraph.model.image_times import Seconds
from calibgraph.model.rig import Camera, Finite, Size, Transform

_DERIVED = "computed from T_cam_lidar"


def write_kalibr(export: RigExport) -> str:
    """A camchain: cam0, cam1, ... in the order of the rig."""
    names = list(export.cameras)
    content = {f"cam{i}": _content(export, names, i) for i in range(len(names))}
    statement = export.statement(
        "T_cam_lidar maps LiDAR to camera coordinates: p_camera = T_cam_lidar * p_lidar",
        "T_cn_cnm1 of cam n maps coordinates of cam n-1 to those of cam n",
        f"cameras: {', '.join(f'cam{i} is {name}' for i, name in enumerate(names))}; "
        "correct the rostopics",
        COVARIANCE_SENTENCE,
    )
    return commented_yaml(statement, content)


def _content(export: RigExport, names: list[str], index: int) -> dict[str, Any]:
    name = names[index]
    camera = export.cameras[name]
    own: dict[str, Any] = {"camera": name}
    chain: dict[str, Any] = {}
    if index:
        before = export.cameras[names[index - 1]]
        chain["T_cn_cnm1"] = relative_transform(camera.T_camera_lidar, before.T_camera_lidar)
        own["T_cn_cnm1"] = _DERIVED
    covariance = export.ros_covariance(name)
    if covariance is not None:
        own["covariance"] = covariance.ravel()
    return {
        **_projection(name, camera),
        "resolution": [camera.width_px, camera.height_px],
        "rostopic": f"/{name}/image_raw",
        **chain,
        "T_cam_lidar": camera.T_camera_lidar,
        **_time_shift(camera),
        "calibgraph": own,
    }


def _time_shift(camera: Camera) -> dict[str, Any]:
    """As Kalibr's timeshift_cam_imu: the LiDAR's time of an image is the camera's plus it."""
    known = camera.time_offset_s is not None
    return {"timeshift_cam_lidar": camera.time_offset_s} if known else {}


def _projection(name: str, camera: Camera) -> dict[str, Any]:
    k = camera.intrinsics_px
    focal = [k.fx, k.fy, k.cx, k.cy]
    if camera.model == "omnidirectional":
        xi, *coefficients = camera.distortion
        return {
            "camera_model": "omni",
            "intrinsics": [xi, *focal],
            "distortion_model": "radtan",
            "distortion_coeffs": coefficients,
        }
    return {"camera_model": "pinhole", "intrinsics": focal, **_distortion(name, camera)}


def _distortion(name: str, camera: Camera) -> dict[str, Any]:
    if camera.model == "equirectangular":
        raise no_place_for(name, camera, "Kalibr's camchain")
    if camera.model == "fisheye":
        return {"distortion_model": "equidistant", "distortion_coeffs": camera.distortion}
    if not any(camera.distortion):
        return {"distortion_model": "none", "distortion_coeffs": []}
    coefficients = carried_coefficients(name, camera, 4, "Kalibr's radtan")
    return {"distortion_model": "radtan", "distortion_coeffs": coefficients}


class _Own(StrictNumbers):
    camera: str | None = None
    T_cn_cnm1: str = ""


class _Camera(StrictNumbers):
    model_config = ConfigDict(arbitrary_types_allowed=True)

    camera_model: str
    intrinsics: tuple[Finite, ...]
    distortion_model: str = "none"
    distortion_coeffs: tuple[Finite, ...] = ()
    resolution: tuple[Size, Size] | None = None
    T_cn_cnm1: Transform | None = None
    T_cam_lidar: Transform | None = None
    T_cam_imu: Transform | None = None
    timeshift_cam_lidar: Seconds | None = None
    calibgraph: _Own = _Own()


class _Camchain(StrictNumbers):
    cameras: Annotated[dict[str, _Camera], Field(min_length=1)]


def is_kalibr(content: dict[str, Any]) -> bool:
    """Whether the content of a YAML file is a camchain."""
    return "cam0" in content


def read_kalibr(content: dict[str, Any], path: Path) -> Part:
    """Lenses, T_cam_lidar where it is given, and T_cn_cnm1 as relative poses.

    T_cam_imu maps IMU to camera coordinates: a file with the LiDAR in the IMU completes it.
    """
    keys = sorted((key for key in content if re.fullmatch(r"cam\d+", str(key))), key=_number)
    chain = checked_model(_Camchain, {"cameras": {key: content[key] for key in keys}}, path)
    names = {key: camera.calibgraph.camera or key for key, camera in chain.cameras.items()}
    if len(set(names.values())) < len(names):
        raise FileError(path, f"two cameras have one name: {', '.join(names.values())}")
    in_imu = {names[key]: camera.T_cam_imu for key, camera in chain.cameras.items()}
    frames = {name: f"{name}_optical_frame" for name, T in in_imu.items() if T is not None}
    return Part(
        path=path,
        lenses={names[key]: _lens(camera, path) for key, camera in chain.cameras.items()},
        T_camera_lidar={
            names[key]: camera.T_cam_lidar
            for key, camera in chain.cameras.items()
            if camera.T_cam_lidar is not None
        },
        relative_poses=tuple(_relative_poses(keys, chain, names)),
        links=tuple(
            FrameLink(IMU, frames[name], invert(T)) for name, T in in_imu.items() if T is not None
        ),
        frame_ids=frames,
    )


def _relative_poses(
    keys: list[str], chain: _Camchain, names: dict[str, str]
) -> Iterator[RelativeCamera]:
    """Each camera to the one before it, unless that was computed from their extrinsics."""
    for before, key in zip(keys, keys[1:], strict=False):
        camera = chain.cameras[key]
        if camera.T_cn_cnm1 is not None and camera.calibgraph.T_cn_cnm1 != _DERIVED:
            yield RelativeCamera(names[key], names[before], camera.T_cn_cnm1)


def _number(key: str) -> int:
    return int(key[3:])


def _lens(camera: _Camera, path: Path) -> CameraLens:
    return replace(_projection_of(camera, path), time_offset_s=camera.timeshift_cam_lidar)


def _projection_of(camera: _Camera, path: Path) -> CameraLens:
    names = camera.model_dump(include={"camera_model", "distortion_model"})
    model = stated_model(names, path) or "pinhole"
    if model == "omnidirectional":
        return _omnidirectional(camera, path)
    intrinsics = listed_intrinsics(camera.intrinsics, f"{path}: intrinsics")
    coefficients = listed_coefficients(camera.distortion_coeffs, model, path)
    return CameraLens(model, camera.resolution, intrinsics, coefficients)


def _omnidirectional(camera: _Camera, path: Path) -> CameraLens:
    """Kalibr's omni-radtan or omni-none: xi comes before the focal lengths."""
    intrinsics = listed_intrinsics(camera.intrinsics[1:], f"{path}: intrinsics after xi")
    coefficients = unified_coefficients(camera.intrinsics[0], camera.distortion_coeffs, path)
    return CameraLens("omnidirectional", camera.resolution, intrinsics, coefficients)

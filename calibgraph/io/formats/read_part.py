"""One file of another program, in the format that its name or content shows."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from calibgraph.errors import FileError
from calibgraph.files import read_text, require_file
from calibgraph.io.bags import is_bag
from calibgraph.io.bags.rig import read_bag_rig
from calibgraph.io.formats.autoware import is_autoware, read_autoware
from calibgraph.io.formats.camera_info import is_camera_info, read_camera_info
from calibgraph.io.formats.documents import (
    YAML_SUFFIXES,
    content_of_storage,
    read_documents,
    read_xml,
)
from calibgraph.io.formats.foreign_keys import read_foreign
from calibgraph.io.formats.kalibr import is_kalibr, read_kalibr
from calibgraph.io.formats.matrix_lines import read_lines
from calibgraph.io.formats.part import Part, RelativeCamera
from calibgraph.io.formats.ros_transforms import (
    is_tf2,
    publisher_lines,
    read_publishers,
    read_tf2,
    read_urdf,
)
from calibgraph.io.kitti import CALIBRATION_NAME
from calibgraph.io.lenses import CameraLens
from calibgraph.io.rigs import is_exported_rig, read_rig
from calibgraph.model.rig import KNOWLEDGE, Camera

_MAX_BYTES, _HEAD_BYTES = 32 * 2**20, 2**16


def read_part(path: Path, name: str | None) -> Part:  # noqa: PLR0911 - a line for each kind
    """Read a file; ``name`` replaces the file's own name of its camera if it has a single one.

    Raises:
        FileError: if the format is unknown, or the file malformed.
    """
    if is_bag(path):
        return _part_of_bag(path)
    if path.is_dir() or path.name == CALIBRATION_NAME:
        return _part_of_rig(path)
    suffix = require_file(path).suffix.lower()
    if path.stat().st_size > _MAX_BYTES:
        raise FileError(path, f"{path.stat().st_size} bytes are too many for a calibration")
    if suffix in (".urdf", ".xml", ".xacro", ".launch"):
        return _read_xml(path, name)
    if suffix in (".sh", ".bash"):
        return read_publishers(read_text(path).splitlines(), path)
    if suffix in (".txt", ".csv", ".npy"):
        return _read_lines(path, name)
    if suffix in (*YAML_SUFFIXES, ".json"):
        return _read_content(read_documents(path), path, name)
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).decode("utf-8", "replace")
    raise FileError(path, _unknown(f"a file {suffix or 'without a suffix'} is", head))


def _read_xml(path: Path, name: str | None) -> Part:
    """What a URDF, a launch file or OpenCV's storage holds."""
    root = read_xml(path)
    if root.tag == "launch":
        return read_publishers(publisher_lines(root), path)
    if root.tag == "opencv_storage":
        return _read_content([content_of_storage(root)], path, name)
    return read_urdf(root, path)


def _read_lines(path: Path, name: str | None) -> Part:
    """What a text file of lines holds."""
    found = read_lines(path, name)
    if found is not None:
        return found
    text = read_text(path)
    first = next((line for line in text.splitlines() if line.strip()), "")
    raise FileError(path, _unknown(f"its line {first[:40]!r} is", text))


def _unknown(what: str, text: str = "") -> str:
    """The error of a format that is not known, with the way to a file that is."""
    if "static_transform_publisher" in text or "Rotation: in Quaternion" in text:
        return (
            "states transforms of ROS in lines that are not read; start what publishes them, and "
            "write them into a file that is: `ros2 topic echo --once /tf_static > tf.yaml`"
        )
    if "camera matrix" in text:
        return "is the .ini of camera_calibration; give the .yaml that it writes beside it"
    return (
        f"{what} of no known format; known are those of Kalibr, ROS (camera_info, /tf_static, "
        "URDF), OpenCV, Autoware, KITTI, COLMAP and others in docs/formats.md; or write "
        "T_camera_lidar into rig.yaml"
    )


def _read_content(documents: list[dict[str, Any]], path: Path, name: str | None) -> Part:
    """What the mappings of a file hold."""
    content = documents[0]
    if is_tf2(content):
        return read_tf2(documents, path)
    if is_camera_info(content):
        documents = [content, *(each for each in documents if _message(each) != _message(content))]
    if len(documents) > 1:
        raise FileError(path, f"holds {len(documents)} different YAML documents; keep one of them")
    for matches, read in _READERS:
        if matches(content):
            return read(content, path, name)
    found = read_foreign(content, path, name)
    if found is None:
        keys = ", ".join(str(key) for key in list(content)[:5])
        raise FileError(path, _unknown(f"its keys ({keys}) are"))
    return found


def _message(content: dict[str, Any]) -> dict[str, Any]:
    """A message without its header, whose stamp changes."""
    return {**content, "header": None}


def _is_rig(content: dict[str, Any]) -> bool:
    return "format" in content or is_exported_rig(content)


_READERS: tuple[tuple[Callable[[dict[str, Any]], bool], Callable[..., Part]], ...] = (
    (is_camera_info, read_camera_info),
    (_is_rig, lambda _, path, __: _part_of_rig(path)),
    (is_kalibr, lambda content, path, _: read_kalibr(content, path)),
    (is_autoware, lambda content, path, _: read_autoware(content, path)),
)


def _part_of_bag(path: Path) -> Part:
    """Lenses from camera_info, and the extrinsics that /tf_static has."""
    read = read_bag_rig(path)
    cameras = read.cameras
    found = {name: camera.T_camera_lidar for name, camera in cameras.items()}
    return Part(
        path,
        lenses={name: camera.stated.lens for name, camera in cameras.items()},
        T_camera_lidar={name: T for name, T in found.items() if T is not None},
        frame_ids={name: each.frame_id for name, each in cameras.items() if each.frame_id},
        mounts={name: each.mount for name, each in cameras.items() if each.mount},
        lidar=read.lidar,
        notes=tuple(read.notes),
    )


def _part_of_rig(path: Path) -> Part:
    rig, notes = read_rig(path)
    return Part(
        path,
        lenses={name: _lens(camera) for name, camera in rig.cameras.items()},
        T_camera_lidar=rig.T_camera_lidar,
        relative_poses=tuple(
            RelativeCamera(p.a, p.b, p.T_a_b, p.rotation_sigma_rad, p.translation_sigma_m)
            for p in rig.relative_poses
        ),
        frame_ids={name: each.frame_id for name, each in rig.cameras.items() if each.frame_id},
        mounts={name: each.mount for name, each in rig.cameras.items() if each.mount},
        lidar=rig.lidar,
        notes=notes,
    )


def _lens(camera: Camera) -> CameraLens:
    size = (camera.width_px, camera.height_px)
    stated = {name: getattr(camera, name) for name in KNOWLEDGE}
    return CameraLens(camera.model, size, camera.intrinsics_px, camera.distortion, stated=stated)

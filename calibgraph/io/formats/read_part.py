"""One file of another program, in the format that its name or content shows."""

from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

from pydantic import Field

from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model, read_text, require_file
from calibgraph.io.bags import is_bag
from calibgraph.io.bags.camera_info import lens_of
from calibgraph.io.bags.rig import read_bag_rig
from calibgraph.io.formats.documents import YAML_SUFFIXES, read_documents, read_xml
from calibgraph.io.formats.foreign_keys import read_foreign
from calibgraph.io.formats.matrix_file import read_matrix
from calibgraph.io.formats.transforms import (
    is_autoware,
    is_tf2,
    publisher_lines,
    read_autoware,
    read_publishers,
    read_tf2,
    read_urdf,
)
from calibgraph.io.kitti import CALIBRATION_NAME
from calibgraph.io.lenses import CameraLens
from calibgraph.io.rig_parts import RelativeCamera, RigParts
from calibgraph.io.rigs import is_exported_rig, read_rig
from calibgraph.model.rig import KNOWLEDGE, Camera, Finite, Size

_MAX_BYTES, _HEAD_BYTES = 32 * 2**20, 2**16


def read_part(path: Path, name: str | None) -> RigParts:  # noqa: PLR0911 - a line for each kind
    """Read a file; ``name`` replaces the file's own name of its camera if it has a single one.

    Raises:
        FileError: if the format is unknown, or the file malformed.
    """
    if is_bag(path):
        return read_bag_rig(path)
    if path.is_dir() or path.name == CALIBRATION_NAME:
        return _part_of_rig(path)
    suffix = require_file(path).suffix.lower()
    if path.stat().st_size > _MAX_BYTES:
        raise FileError(path, f"{path.stat().st_size} bytes are too many for a calibration")
    if suffix in (".urdf", ".xml", ".xacro", ".launch"):
        return _read_xml(path)
    if suffix in (".sh", ".bash"):
        return read_publishers(read_text(path).splitlines(), path)
    if suffix in (".txt", ".csv", ".npy"):
        return _read_matrix(path, name)
    if suffix in (*YAML_SUFFIXES, ".json"):
        return _read_content(read_documents(path), path, name)
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).decode("utf-8", "replace")
    raise FileError(path, _unknown(f"a file {suffix or 'without a suffix'} is", head))


def _read_xml(path: Path) -> RigParts:
    """What a URDF or a launch file holds."""
    root = read_xml(path)
    if root.tag == "launch":
        return read_publishers(publisher_lines(root), path)
    if root.tag == "opencv_storage":
        raise FileError(path, "is OpenCV's XML, which is not read; write it to a name in .yml")
    return read_urdf(root, path)


def _read_matrix(path: Path, name: str | None) -> RigParts:
    found = read_matrix(path, name)
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
        "URDF), OpenCV, Autoware, KITTI and others in docs/formats.md; or write "
        "T_camera_lidar into rig.yaml"
    )


def _read_content(documents: list[dict[str, Any]], path: Path, name: str | None) -> RigParts:
    """What the mappings of a file hold."""
    content = documents[0]
    if is_tf2(content):
        return read_tf2(documents, path)
    if _is_camera_info(content):
        documents = [content, *(each for each in documents if _message(each) != _message(content))]
    if len(documents) > 1:
        raise FileError(path, f"holds {len(documents)} different YAML documents; keep one of them")
    if _is_camera_info(content):
        return _read_camera_info(content, path, name)
    if "format" in content or is_exported_rig(content):
        return _part_of_rig(path)
    if is_autoware(content):
        return read_autoware(content, path)
    found = read_foreign(content, path, name)
    if found is None:
        keys = ", ".join(str(key) for key in list(content)[:5])
        raise FileError(path, _unknown(f"its keys ({keys}) are"))
    return found


def _message(content: dict[str, Any]) -> dict[str, Any]:
    """A message without its header, whose stamp changes."""
    return {**content, "header": None}


_Count = Annotated[int, Field(ge=0, le=1_000_000)]


_Nine = Annotated[list[Finite], Field(min_length=9, max_length=9)]
_Twelve = Annotated[list[Finite], Field(min_length=12, max_length=12)]


class _Header(StrictNumbers):
    frame_id: str = ""


class _Window(StrictNumbers):
    x_offset: _Count = 0
    y_offset: _Count = 0
    height: _Count = 0
    width: _Count = 0


class _Message(StrictNumbers):
    header: _Header = _Header()
    height: Size
    width: Size
    distortion_model: str
    d: list[Finite]
    k: _Nine
    r: _Nine
    p: _Twelve
    binning_x: _Count = 0
    binning_y: _Count = 0
    roi: _Window = _Window()


def _is_camera_info(content: dict[str, Any]) -> bool:
    """Whether the content of a file is a CameraInfo message, as ``ros2 topic echo`` prints it."""
    keys = {str(key).lower() for key in content}  # in capitals: K of ROS 1
    return {"height", "width", "distortion_model", "k", "d", "p"} <= keys


def _read_camera_info(content: dict[str, Any], path: Path, name: str | None) -> RigParts:
    """The lens of the images as recorded (K and D, not the rectified P), and the camera's frame."""
    message = checked_model(_Message, {str(key).lower(): v for key, v in content.items()}, path)
    stated = lens_of(SimpleNamespace(**dict(message)), str(path), rectified=False)
    camera = name or path.stem
    return RigParts(
        path, {camera: stated.lens}, frame_ids={camera: stated.frame} if stated.frame else {}
    )


def _part_of_rig(path: Path) -> RigParts:
    rig, notes = read_rig(path)
    return RigParts(
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

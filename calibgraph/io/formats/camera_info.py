"""CameraInfo: messages as ``ros2 topic echo`` prints them, and files of ``camera_info_manager``."""

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Final

import numpy as np
from pydantic import AliasChoices, Field

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.files import StrictNumbers, checked_model
from calibgraph.io.bags.camera_info import lens_of
from calibgraph.io.formats.documents import commented_yaml
from calibgraph.io.formats.part import Part
from calibgraph.io.formats.rig_export import RigExport, frame_id, no_place_for
from calibgraph.model.rig import Camera, Finite, Size

_MODELS: Final = {"pinhole": "plumb_bob", "fisheye": "equidistant", "omnidirectional": "mei"}
_PLUMB_BOB = 5
"""Text of exported lenses alone."""
_Count = Annotated[int, Field(ge=0, le=1_000_000)]


def _list_of(name: str, length: int | None) -> Any:
    """A list of numbers under its name in ROS 1 or 2."""
    return Field(validation_alias=AliasChoices(name, name.lower()), min_length=length or 0,
                 max_length=length)  # fmt: skip


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
    D: Annotated[list[Finite], _list_of("D", None)]
    K: Annotated[list[Finite], _list_of("K", 9)]
    R: Annotated[list[Finite], _list_of("R", 9)]
    P: Annotated[list[Finite], _list_of("P", 12)]
    binning_x: _Count = 0
    binning_y: _Count = 0
    roi: _Window = _Window()


def write_camera_infos(export: RigExport) -> Mapping[str, str]:
    """Per name of a file, the lens of one camera, as ROS's ``camera_info_manager`` loads it.

    K and D are of the images as recorded; R is the identity and P is K.

    Raises:
        CalibrationError: if a lens has no name in ROS, or two cameras one name of a file.
    """
    files: dict[str, str] = {}
    for name, camera in export.cameras.items():
        file = f"{frame_id(name)}.yaml"
        if file.casefold() in map(str.casefold, files):  # one file where systems ignore case
            raise CalibrationError(f"camera {name!r}: another has the file {file}; rename one")
        statement = (
            export.origin,
            "K and D are of the images as recorded, R is the identity, P is K",
            "the extrinsic is not part of a camera_info: export it as tf2, ros2-launch or urdf",
            f"optical frame: {export.optical_frames[name]}",
        )
        files[file] = commented_yaml(statement, _content(name, camera))
    return files


def _content(name: str, camera: Camera) -> dict[str, Any]:
    K, distortion = camera.matrix_px, [*camera.distortion]
    if camera.model == "pinhole":
        distortion += [0.0] * (_PLUMB_BOB - len(distortion))
    is_rational = camera.model == "pinhole" and len(distortion) > _PLUMB_BOB
    model = "rational_polynomial" if is_rational else _MODELS.get(camera.model)
    if model is None:
        raise no_place_for(name, camera, "ROS's camera_info")
    return {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_name": frame_id(name),
        "camera_matrix": _matrix(K),
        "distortion_model": model,
        "distortion_coefficients": _matrix(np.array([distortion])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.column_stack([K, np.zeros(3)])),
    }


def _matrix(values: Array) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}


def is_camera_info(content: dict[str, Any]) -> bool:
    """Whether the content of a YAML file is a CameraInfo message."""
    return {"height", "width", "distortion_model"} <= content.keys() and (
        {"K", "D", "P"} <= content.keys() or {"k", "d", "p"} <= content.keys()
    )


def read_camera_info(content: dict[str, Any], path: Path, name: str | None) -> Part:
    """The lens of the images as recorded (K and D, not the rectified P), and the camera's frame."""
    message = checked_model(_Message, content, path)
    stated = lens_of(SimpleNamespace(**dict(message)), str(path), rectified=False)
    camera = name or path.stem
    return Part(
        path, {camera: stated.lens}, frame_ids={camera: stated.frame} if stated.frame else {}
    )

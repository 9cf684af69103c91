"""CameraInfo: messages as ``ros2 topic echo`` prints them, and files of ``camera_info_manager``."""

from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

from pydantic import AliasChoices, Field

from calibgraph.files import StrictNumbers, checked_model
from calibgraph.io.bags.camera_info import lens_of
from calibgraph.io.formats.part import Part
from calibgraph.model.rig import Finite, Size

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

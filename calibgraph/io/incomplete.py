"""Rigs of data sets in which a camera lacks a part: the others are read."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from calibgraph.errors import FileError
from calibgraph.files import checked_model
from calibgraph.model.rig import Camera, Rig


class IncompleteCamera(FileError):
    """A camera without its lens, its pose or its images; what is there but wrong is no such."""


class RigRead(NamedTuple):
    """The complete cameras of a data set, and what was left out or assumed, a line each."""

    rig: Rig
    notes: tuple[str, ...] = ()


def rig_of_complete(
    lidar: str, names: Iterable[str], read: Callable[[str], Camera], path: Path
) -> RigRead:
    """The rig of the cameras that have all parts."""
    cameras: dict[str, Camera] = {}
    missing: dict[str, IncompleteCamera] = {}
    for name in names:
        try:
            cameras[name] = read(name)
        except IncompleteCamera as error:
            missing[name] = error
    if missing and not cameras:
        raise next(iter(missing.values()))
    notes = tuple(f"{error}: camera {name!r} is left out" for name, error in missing.items())
    return RigRead(checked_model(Rig, {"lidar": lidar, "cameras": cameras}, path), notes)

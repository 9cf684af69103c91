"""What readers of published data sets return: frames, and the rig of the complete cameras."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from calibgraph.errors import FileError
from calibgraph.files import checked_model
from calibgraph.io.frame import Frame
from calibgraph.model.rig import Camera, Rig


class IncompleteCamera(FileError):
    """A camera without its lens, its pose or its images; what is there but wrong is no such."""


class PublishedFolder(NamedTuple):
    """A folder of a published data set, read as far as it is asked.

    Attributes:
        lidar: its name.
        cameras: their names.
        read: the lens and T_camera_lidar of one; IncompleteCamera if a part is missing.
        frames: the clouds in order, with the images of the cameras that have one.
    """

    lidar: str
    cameras: Callable[[], Sequence[str]]
    read: Callable[[str], Camera]
    frames: Callable[[Sequence[str]], list[Frame]]

    def read_rig(self, path: Path) -> tuple[Rig, tuple[str, ...]]:
        """The rig of the cameras that have all parts, with notes; the path is for errors."""
        cameras: dict[str, Camera] = {}
        missing: dict[str, IncompleteCamera] = {}
        for name in self.cameras():
            try:
                cameras[name] = self.read(name)
            except IncompleteCamera as error:
                missing[name] = error
        if missing and not cameras:
            raise next(iter(missing.values()))
        notes = tuple(f"{error}: camera {name!r} is left out" for name, error in missing.items())
        return checked_model(Rig, {"lidar": self.lidar, "cameras": cameras}, path), notes

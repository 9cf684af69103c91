"""What readers of published data sets return: frames, and the rig of the complete cameras."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from calibgraph.files import checked_model
from calibgraph.io.frame import Frame
from calibgraph.io.rig_parts import IncompleteCamera
from calibgraph.model.rig import Camera, Rig


class PublishedFolder(NamedTuple):
    """A folder of a published data set, read as far as it is asked.

    Attributes:
        content: what its rig has besides cameras.
        cameras: their names.
        read: the lens and T_camera_lidar of one; IncompleteCamera if a part is missing.
        frames: the clouds in order, with the images of the cameras that have one.
    """

    content: Callable[[], Mapping[str, Any]]
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
        return checked_model(Rig, {**self.content(), "cameras": cameras}, path), notes

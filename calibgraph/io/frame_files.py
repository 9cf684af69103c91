"""What readers of data sets return: the files of frames, and the rig of the complete cameras."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from calibgraph.errors import FileError
from calibgraph.files import checked_model, is_utf8, require_file
from calibgraph.model.rig import Camera, Rig

_PCD = ".pcd"  # NAME.pcd.bin is a cloud of nuScenes


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame, which share their stem."""

    stem: str
    cloud: Path
    images: dict[str, Path]


def files_by_stem(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """Files of a folder with one of the suffixes, by stem, in order."""
    kinds = ", ".join(suffixes)
    if not folder.is_dir():
        beside = ", ".join(sorted(path.name for path in folder.parent.glob("*/"))) or "none"
        raise FileError(
            folder, f"no such folder; put the files ({kinds}) there, found are the folders {beside}"
        )
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in suffixes and not path.name.startswith("."):
            stem = path.stem.removesuffix(_PCD) if path.suffix == ".bin" else path.stem
            if stem in files:
                raise FileError(path, f"and {files[stem].name} are the same frame; keep one")
            if not is_utf8(path.name):
                raise FileError(path, "its name is not UTF-8; rename it")
            files[stem] = require_file(path)
    if not files:
        raise FileError(folder, f"holds no file of a known kind; write or convert to {kinds}")
    return files


def frames_by_stem(
    clouds: Mapping[str, Path], images: Mapping[str, Mapping[str, Path]]
) -> list[FrameFiles]:
    """A frame per cloud, with the images of each camera that have its stem."""
    return [
        FrameFiles(stem, cloud, {name: of[stem] for name, of in images.items() if stem in of})
        for stem, cloud in clouds.items()
    ]


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

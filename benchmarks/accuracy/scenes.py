"""Recorded and simulated data, and ways to change their images and clouds, for ``cases``."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibgraph import Camera, Dataset, Frame, Rig, load_dataset, load_rig, perturb

Array = np.ndarray

GUESS_DEG, GUESS_M = 2.0, 0.2
MOTORWAY = "01"
SEQUENCES = {
    "tune": ("00", "kitti_raw_0005", "surround6", "vlp16_distorted", "dgp_scene01", "opencalib_a"),
    "count": ("05", "06", "07", "08", "06+07+08", "acfr_vlp16_fisheye", "sustech", "nuscenes_a"),
}
ONE_CAMERA = ("vlp16_distorted", "opencalib_a", "acfr_vlp16_fisheye")
FEW_FRAMES = ("nuscenes_a", "opencalib_a")
"""Recordings of one camera, and of one or two frames: some kinds need more."""
OTHER = {"00": "01", "01": "00", "05": "06", "06": "07", "07": "08", "08": "05", "06+07+08": "05"}
"""Which sequence's images replace a sequence's own, of the same rig; else its own other half."""


@dataclass(frozen=True)
class Folders:
    """Where the data are.

    Attributes:
        realdata: of the recordings, or None.
        scenes: of simulated streets ``scene_0``, ``scene_1``, ..., or None.
    """

    realdata: Path | None
    scenes: Path | None

    def names(self, which: str) -> list[str]:
        """The data of a set, but for the motorway: sequences, and scenes by odd or even number."""
        names = list(SEQUENCES[which]) if self.realdata is not None else []
        found = sorted(self.scenes.glob("scene_*")) if self.scenes is not None else []
        odd = which == "count"
        return names + [path.name for path in found if int(path.name.split("_")[1]) % 2 == odd]

    def load(self, name: str) -> tuple[Dataset, Rig]:
        """Data by name, and the true rig."""
        if name.startswith("scene_"):
            folder = _known(self.scenes, "--scenes") / name
            return load_dataset(folder), load_rig(folder / "reference.yaml")
        recorded = _known(self.realdata, "--realdata")
        if (recorded / name / "reference.yaml").is_file():
            return load_dataset(recorded / name), load_rig(recorded / name / "reference.yaml")
        sequences = recorded / "kitti_odometry" / "sequences"
        data = load_dataset([sequences / part for part in name.split("+")])
        return data, data.rig

    def images_for(self, name: str) -> Dataset:
        """Data of the same rig whose images show another place."""
        if not name.startswith("scene_"):
            return self.load(OTHER.get(name, name))[0]
        own = int(name.split("_")[1])
        others = [n for which in SEQUENCES for n in self.names(which) if n.startswith("scene_")]
        same_set = [n for n in others if n != name and (int(n.split("_")[1]) - own) % 2 == 0]
        return self.load(same_set[0] if same_set else name)[0]


def _known(folder: Path | None, option: str) -> Path:
    if folder is None:
        raise ValueError(f"this case needs {option}")
    return folder


@dataclass(frozen=True, eq=False)
class Scene:
    """Good data, for a case to spoil.

    Attributes:
        name: of the data.
        data: the frames.
        truth: the true rig.
        folders: where other data are.
        scratch: an empty folder, removed after the case.
        seed: of the guess.
    """

    name: str
    data: Dataset
    truth: Rig
    folders: Folders
    scratch: Path
    seed: int

    def guess(self, deg: float = GUESS_DEG, m: float = GUESS_M) -> Rig:
        """The truth, displaced."""
        return perturb(self.truth, rotation_deg=deg, translation_m=m, seed=self.seed)

    @property
    def pair(self) -> tuple[str, str]:
        """The two cameras that look ahead."""
        first, second = list(self.truth.cameras)[:2]
        return first, second


Case = tuple[Any, Rig, dict[str, Any]]
"""Data or a table, the rig with its guess, and what was drawn for this kind of case."""


def with_images(data: Dataset, paths: Callable[[int, Frame], dict[str, Path]]) -> Dataset:
    """The data with other images."""
    frames = (replace(f, image_paths=paths(i, f)) for i, f in enumerate(data.frames))
    return replace(data, frames=tuple(frames))


def with_clouds(scene: Scene, change: Callable[[Array], Array]) -> Dataset:
    """The data with changed clouds, in the scratch folder."""
    frames = []
    for frame in scene.data.frames:
        path = scene.scratch / f"{frame.index:06d}.npy"
        np.save(path, change(frame.load_cloud()).astype(np.float32))
        frames.append(replace(frame, cloud_path=path))
    return replace(scene.data, frames=tuple(frames))


Painter = Callable[[Array, int, Camera], Array]
"""An image, the number of its frame and its camera, to the changed image."""


def paint_images(scene: Scene, names: Collection[str], paint: Painter) -> Dataset:
    """The data with the images of some cameras changed, in the scratch folder."""

    def paths(index: int, frame: Frame) -> dict[str, Path]:
        changed = dict(frame.image_paths)
        for name in filter(names.__contains__, frame.image_paths):
            camera = scene.truth.cameras[name]
            changed[name] = scene.scratch / f"{name}_{index:06d}.png"
            cv2.imwrite(str(changed[name]), paint(frame.load_image(name, camera), index, camera))
        return changed

    return with_images(scene.data, paths)

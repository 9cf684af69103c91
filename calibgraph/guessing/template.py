"""A rig file to fill in, from the images and clouds of a dataset folder."""

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from shlex import join

import numpy as np

from calibgraph.errors import FileError
from calibgraph.files import require_new_file, write_text
from calibgraph.guessing.mounting import check_forward, parse_lens, parse_mounting
from calibgraph.io.bags import is_bag
from calibgraph.io.clouds import CLOUD_SUFFIXES
from calibgraph.io.dataset_folders import folder_layout, published_folder
from calibgraph.io.frame_files import files_by_stem
from calibgraph.io.images import IMAGE_SUFFIXES, image_size
from calibgraph.io.kitti import CALIBRATION_NAME
from calibgraph.io.rigs import FILL_IN, RIG_FILE
from calibgraph.model.rig import RIG_FORMAT
from calibgraph.yaml_text import yaml_text


def write_rig_template(
    folder: Path | str,
    out: Path | str | None = None,
    *,
    mountings: Mapping[str, str] | None = None,
    lenses: Mapping[str, str] | None = None,
    forward: str = "+x",
    replace: bool = False,
) -> Path:
    """Write a rig file with the cameras of a dataset folder, and placeholders to fill in.

    Args:
        folder: with ``lidar/`` and ``cameras/NAME/``.
        out: the file; ``rig.yaml`` in the folder if None.
        mountings: per camera, how it is mounted, in the words of :func:`calibgraph.guess_rig`; its
            guess is then no placeholder.
        lenses: per camera, how its lens is known: ``LENS_GRAMMAR``; a lens of a spec sheet or a
            field of view is computed, with sigmas of a lens in doubt.
        forward: the axis of the LiDAR frame that points ahead, for the words.
        replace: whether a file that is there is replaced.

    Returns:
        The file.

    Raises:
        FileError: if the folder has no clouds or images or brings a rig of its own, or if the file
            is there already.
        RigError, ValueError: if words are not understood, or name no camera of the folder.
    """
    folder, mountings, lenses = Path(folder), mountings or {}, lenses or {}
    path = Path(out) if out is not None else folder / RIG_FILE
    require_new_file(path, ".yaml", ".yml", force=replace)
    sources = cameras_of_folder(folder)
    clouds = len(files_by_stem(folder / "lidar", CLOUD_SUFFIXES))
    for option, words in (("--mount", mountings), ("--lens", lenses)):
        for name in words.keys() - sources.keys():
            raise ValueError(f"{option} {name}=...: no such camera; found are {', '.join(sources)}")
    cameras = {}
    for name, source in sources.items():
        size_px = image_size(next(iter(files_by_stem(source, IMAGE_SUFFIXES).values())))
        cameras[name] = _camera(name, size_px, (mountings.get(name), lenses.get(name)), forward)
    head = (files("calibgraph.guessing") / "rig_head.txt").read_text(encoding="utf-8")
    own = [] if out is None else [str(out)]
    head = head.format(
        fill_in=FILL_IN, where=join([str(folder), *("--rig" for _ in own), *own]),
        again=join([str(folder), *("--out" for _ in own), *own, "--force"]), clouds=clouds,
        cameras=", ".join(cameras),
    )  # fmt: skip
    content = {"format": RIG_FORMAT, "lidar": "lidar", "cameras": cameras}
    write_text(path, head + yaml_text(content))
    return path


def cameras_of_folder(folder: Path) -> dict[str, Path]:
    """The images of each camera; arguments and errors as of :func:`write_rig_template`."""
    _require_plain_folder(folder)
    _, sources = folder_layout(folder)
    if not sources:
        beside = ", ".join(sorted(path.name for path in folder.glob("*/"))) or "none"
        raise FileError(
            folder / "cameras", "no images; put those of each camera into cameras/NAME, named as "
            f"the clouds in lidar, found are the folders {beside}"
        )  # fmt: skip
    return sources


def _require_plain_folder(folder: Path) -> None:
    """Refuse a dataset that has its own lenses."""
    if is_bag(folder):
        raise FileError(
            folder, "is a ROS bag with lenses of its own; calibgraph rig BAG writes them"
        )
    if not folder.is_dir():
        raise FileError(folder, "no such folder; expected one with lidar/ and cameras/NAME/")
    if published_folder(folder) or (folder / CALIBRATION_NAME).is_file():
        raise FileError(
            folder, "brings its own rig, from which calibrate starts; calibgraph doctor shows it"
        )


def _camera(
    name: str, size_px: tuple[int, int], said: tuple[str | None, str | None], forward: str
) -> dict[str, object]:
    """A camera of the file, by what is said of its mounting and its lens."""
    guess: object = FILL_IN
    words, lens = said
    known = None if lens is None else parse_lens(lens, name, size_px)
    unknown = {
        "intrinsics_px": dict.fromkeys(("fx", "fy", "cx", "cy"), FILL_IN),
        "distortion": FILL_IN,
    }
    if words is not None:
        T = parse_mounting(words, name).T_camera_lidar(check_forward(forward))
        guess = (np.round(T, 6) + 0.0).tolist()
    return {
        "model": "pinhole",
        "width_px": size_px[0],
        "height_px": size_px[1],
        **(known or unknown),
        "T_camera_lidar": guess,
    }

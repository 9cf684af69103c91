"""Examine a dataset before anything is solved: its content, and the problems to fix first."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError, DatasetError
from calibgraph.io.bags import BagOptions, is_bag
from calibgraph.io.clouds import describe_thinned
from calibgraph.io.dataset import Dataset, load_dataset
from calibgraph.io.dataset_folders import frames_of_folder
from calibgraph.io.frame import Frame, hash_source
from calibgraph.io.rigs import describe_rig, load_rig
from calibgraph.matching.burnt_in import describe_burnt_in, hide_burnt_in
from calibgraph.matching.camera_pairs import overlapping_pairs
from calibgraph.matching.cloud_similarity import find_up
from calibgraph.matching.frame_choice import choose_frames, find_stationary_frames
from calibgraph.matching.places import UNKNOWN_UP, find_places
from calibgraph.matching.same_images import find_same_images
from calibgraph.matching.structure.matcher import MOST_FRAMES
from calibgraph.model.places import as_groups, describe_places
from calibgraph.model.rig import Rig
from calibgraph.parallel import map_on_cores
from calibgraph.report.pictures import write_overlays
from calibgraph.solver.covariance import ENOUGH_FRAMES
from calibgraph.trust.inputs import (
    Finding,
    Level,
    count_points_in_view,
    describe_brightness,
    describe_out_of_view,
    describe_repeats,
    explain_guess,
    find_doubts,
)

_Found = dict[Level, list[str]]
"""What is found, the most severe level first."""


@dataclass(frozen=True)
class Diagnosis:
    """The findings in a dataset.

    Attributes:
        findings: errors first, then warnings and notes.
        frames: number of frames that can be calibrated.
        points_in_image: per camera, how many points of a cloud lie in its image by the guess.
        pictures: the guess drawn on one image per camera, where asked for.
    """

    findings: tuple[Finding, ...]
    frames: int = 0
    points_in_image: dict[str, int] = field(default_factory=dict)
    pictures: tuple[Path, ...] = ()

    @property
    def healthy(self) -> bool:
        """Whether nothing has to be fixed first."""
        return all(finding.level != "error" for finding in self.findings)

    def to_mapping(self) -> dict[str, Any]:
        """The diagnosis as plain values."""
        return {
            "healthy": self.healthy,
            "frames": self.frames,
            "points_in_image": self.points_in_image,
            "findings": [vars(finding) for finding in self.findings],
            "pictures": [str(path) for path in self.pictures],
        }


def diagnose(
    folders: Path | str | Sequence[Path | str],
    rig: Rig | None = None,
    *,
    frames: str | None = None,
    bag: BagOptions | None = None,
    pictures: Path | None = None,
) -> Diagnosis:
    """Examine a dataset in seconds: of many frames, those that a calibration would match.

    Args:
        folders: a dataset folder, KITTI odometry sequence or bag, or several of one rig.
        rig: the guess; the data's own if None.
        frames: which frames to keep, see :meth:`calibgraph.Dataset.select`.
        bag: how ROS bags are read.
        pictures: folder for ``guess_CAMERA.png``: the guess on an image of each camera; written
            where there is no error.

    Raises:
        ValueError: if the options do not fit.
    """
    found: _Found = {"error": [], "warning": [], "note": []}
    paths = [*map(Path, [folders] if isinstance(folders, (str, Path)) else folders)]
    data = _load(paths, rig, found, frames=frames, bag=bag)
    count, seen, written = 0, dict[str, int](), list[Path]()
    if data is not None:
        count = len(data.frames)
        _describe(data, found)
        if data.rig.cameras:
            seen, written = _examine(data, found, pictures)
    findings = (Finding(level, text) for level, texts in found.items() for text in texts)
    return Diagnosis(tuple(findings), count, seen, tuple(written))


def _load(
    folders: Sequence[Path], rig: Rig | None, found: _Found, **options: Any
) -> Dataset | None:
    """The dataset, without frames that do not pair up; None if there is none."""
    try:
        return load_dataset(folders, rig, **options)
    except (CalibrationError, OSError) as error:
        found["error"].append(str(error))
        is_selected = options["frames"] is not None or any(map(is_bag, folders))
        if not isinstance(error, DatasetError) or is_selected:
            return None
    try:
        given = rig if rig is not None else load_rig(folders[0])
        cameras = list(given.cameras)
        every = [f for path in folders for f in frames_of_folder(path, cameras, complete=False)[0]]
        paired = [str(i) for i, one in enumerate(every) if one.image_paths.keys() >= {*cameras}]
        return load_dataset(folders, rig, frames=",".join(paired)) if paired else None
    except (CalibrationError, OSError):
        return None


def _describe(data: Dataset, found: _Found) -> None:
    """The content of the dataset, and whether there are enough frames."""
    counts = {"frame": (count := len(data.frames)), "camera": len(data.rig.cameras)}
    counts |= {"LiDAR": len(data.rig.lidars)} if data.rig.lidars else {}
    words = (f"{number} {noun}{'' if number == 1 else 's'}" for noun, number in counts.items())
    found["note"] += [", ".join(words), *data.notes]
    if not set(describe_rig(data.rig)) & set(data.notes):
        found["note"] += describe_rig(data.rig)
    if count < ENOUGH_FRAMES:
        found["warning"].append(
            f"{count} frames: the error bar will be a wide default; record at least "
            f"{ENOUGH_FRAMES}, better 10 to 30 from several places"
        )


def _examine(
    data: Dataset, found: _Found, pictures: Path | None
) -> tuple[dict[str, int], list[Path]]:
    """The points in view of each camera, and the pictures; of images and clouds as matched."""
    found["error"] += find_same_images(data, data.rig)
    data = hide_burnt_in(data, data.rig)
    found["warning"] += describe_burnt_in(data)
    choice = choose_frames(data, data.rig, MOST_FRAMES)
    found["note"] += [choice.text] if choice.text else []
    readable = _examine_frames(choice.dataset.frames, data.rig, found)
    if not readable:
        return {}, []
    frame = readable[len(readable) // 2]
    cloud = frame.load_cloud()
    seen = count_points_in_view(data.rig, cloud)
    _examine_places(choice.dataset, max(seen, key=seen.__getitem__), cloud, found)
    _examine_guess(choice.dataset, frame, seen, found)
    if pictures is None or found["error"]:
        return seen, []
    guess = {name: [camera] for name, camera in data.rig.cameras.items()}
    return seen, write_overlays(frame, guess, pictures)


def _examine_frames(frames: Sequence[Frame], rig: Rig, found: _Found) -> list[Frame]:
    """The frames whose clouds can be read; what is wrong with clouds and images is found."""
    read = map_on_cores(_examine_frame, frames, [rig] * len(frames))
    for source in ("", *rig.cameras):
        problems = [of_frame[source] for of_frame, _ in read if source in of_frame]
        if problems:
            others = f"; {len(problems) - 1} more of its frames have errors" if problems[1:] else ""
            found["error"].append(problems[0] + others)
    levels = {n: [means[n] for _, means in read if n in means] for n in rig.cameras}
    found["warning"] += filter(None, map(describe_brightness, levels, levels.values()))
    found["note"] += describe_thinned(int(measured.get("", 0)) for _, measured in read)
    readable = [f for f, (problems, _) in zip(frames, read, strict=True) if "" not in problems]
    sources = {"cloud": [frame.cloud_path for frame in readable]}
    sources |= {f"image of {n}": [f.image_paths[n] for f in readable] for n in rig.cameras}
    for what, paths in sources.items():
        hashes = zip((f.name for f in readable), map_on_cores(hash_source, paths), strict=True)
        found["warning"] += filter(None, [describe_repeats(what, hashes)])
    return readable


def _examine_frame(frame: Frame, rig: Rig) -> tuple[dict[str, str], dict[str, float]]:
    """The problems of its cloud ("") and of images; its number of points (""), and mean levels."""
    problems, measured = dict[str, str](), dict[str, float]()
    try:
        measured[""] = len(frame.load_cloud())
    except (CalibrationError, OSError) as error:
        problems[""] = str(error)
    for name, camera in rig.cameras.items():
        try:
            gray = frame.load_gray(name, camera)
        except (CalibrationError, OSError) as error:
            problems[name] = str(error)
            continue
        if np.ptp(gray) == 0:
            problems[name] = f"{frame.image_paths[name]}: all pixels are {gray[0, 0]}"
        measured[name] = float(gray.mean())
    return problems, measured


def _examine_places(data: Dataset, camera: str, cloud: NDArray[np.float32], found: _Found) -> None:
    """How many places the frames are of, as a calibration counts them; and whether some repeat."""
    try:
        places = find_places(data, data.rig, camera)
        stops = find_stationary_frames(data, data.rig)
    except (CalibrationError, OSError):  # which is a finding already
        return
    found["note"].append(describe_places(as_groups(places)))
    if find_up(cloud, data.rig.T_camera_lidar.values()) is None:
        found["note"].append(UNKNOWN_UP)
    if stops:
        names = {frame.index: frame.name for frame in data.frames}
        most = max(stops, key=len)
        count = len(data.frames) - sum(len(stop) - 1 for stop in stops)
        found["warning"].append(
            f"{len(data.frames)} frames count as {count}: the vehicle stands, as in {len(most)} "
            f"frames from {names[most[0]]} to {names[most[-1]]}; {ENOUGH_FRAMES} are needed for an "
            "error bar of their own"
        )


def _examine_guess(data: Dataset, frame: Frame, seen: Mapping[str, int], found: _Found) -> None:
    """Impossible values, cameras that see no point at the guess, and overlapping cameras."""
    cloud = frame.load_cloud()
    found["warning"] += find_doubts(data.rig, frame, cloud)
    found["error"] += filter(None, [explain_guess(data, data.rig, cloud)])
    found["error"] += describe_out_of_view(seen)
    found["note"] += [
        f"{n}: {of} of {len(cloud)} points lie in the image" for n, of in seen.items()
    ]
    if len(data.rig.cameras) > 1:
        pairs = ", ".join(f"{a} and {b}" for a, b in overlapping_pairs(data.rig, cloud)) or "none"
        found["note"].append(f"cameras that see the same by the guess: {pairs}")

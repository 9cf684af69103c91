"""Datasets: frames of one rig, from folders and ROS bags, decoded when loaded; or from arrays."""

from __future__ import annotations

import uuid
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from shlex import quote
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, FileError
from calibgraph.io.bag_frames import FoundFrames, frames_of_bag
from calibgraph.io.bags import BagOptions, is_bag
from calibgraph.io.bags.messages import CLOUDS, Bag
from calibgraph.io.bags.rig import doubtful_axes
from calibgraph.io.bags.storage import NEAR_S, REPAIR_ROS2
from calibgraph.io.clouds import (
    RawCloud,
    cloud_of_array,
    describe_cloud,
    only_returns,
    with_intensity,
)
from calibgraph.io.dataset_folders import folder_layout, frames_of_folder, published_folder
from calibgraph.io.frame import Frame, Kept, ScanMotion, twist_by_scans
from calibgraph.io.frame_files import stated_stamps, way_out
from calibgraph.io.rigs import describe_rig, read_rig
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import KeyedCache

Item = TypeVar("Item")

LEAST_INTERVAL_S, MOST_INTERVAL_S = 0.005, 10.0


@dataclass(frozen=True)
class Dataset:
    """Frames of one rig.

    Attributes:
        rig: the rig beside the data: its extrinsics are a guess, or (KITTI) the reference.
        frames: in order of time.
        folders: their sources.
        recorded: all frames of the folders, where only some of them were selected.
        notes: what was found in the first cloud, a bag or tables, and what was left out, a line
            each.
        lidar_errors: per LiDAR but the base, (6, k) twist of it in the base by a standard deviation
            of each of the errors of LiDARs; empty unless clouds are joined.
    """

    rig: Rig
    frames: tuple[Frame, ...]
    folders: tuple[Path, ...]
    recorded: tuple[Frame, ...] = ()
    notes: tuple[str, ...] = ()
    lidar_errors: Mapping[str, Array] = field(default_factory=dict)

    def neighbour(self, frame: Frame, later: int) -> Frame | None:
        """The frame recorded ``later`` frames later in the same folder, selected or not."""
        other = self._by_index.get(frame.index + later)
        same = other is not None and other.cloud_path.parent == frame.cloud_path.parent
        return other if same else None

    @cached_property
    def _by_index(self) -> dict[int, Frame]:
        return {frame.index: frame for frame in (*self.recorded, *self.frames)}

    def spread_out(self, most: int) -> Dataset:
        """At most ``most`` of the frames, evenly spread over them."""
        return self.only(spread_out(self.frames, most))

    def at_instants(self) -> Dataset:
        """The dataset with clouds that count as taken at one instant each."""
        both = (self.frames, self.recorded)
        frames, recorded = (tuple(frame.at_instant() for frame in of) for of in both)
        return replace(self, frames=frames, recorded=recorded)

    def select(self, frames: str) -> Dataset:
        """Keep some frames, by their position among the frames sorted by name, from 0.

        Args:
            frames: ``start:stop:step`` as in Python, or positions separated by commas.
        """
        try:
            if ":" in frames:
                ends = (int(part) if part.strip() else None for part in frames.split(":"))
                kept = self.frames[slice(*ends)]
            else:
                kept = tuple(self.frames[int(part)] for part in frames.split(","))
        except (ValueError, IndexError, TypeError) as error:
            raise ValueError(
                f"frames {frames!r}: expected start:stop:step or positions separated by commas, "
                f"counted from 0 in the {len(self.frames)} frames sorted by name"
            ) from error
        if not kept:
            raise ValueError(f"frames {frames!r} selects none of the {len(self.frames)} frames")
        return self.only(kept)

    def only(self, frames: Sequence[Frame]) -> Dataset:
        """Some of the frames; the others remain ``recorded``."""
        return replace(self, frames=tuple(frames), recorded=self.recorded or self.frames)


def load_dataset(
    folders: Path | str | Sequence[Path | str],
    rig: Rig | None = None,
    *,
    frames: str | None = None,
    bag: BagOptions | None = None,
    interval_s: float | None = None,
) -> Dataset:
    """Find the frames of a dataset, a published data set, a bag, or several of one rig.

    Args:
        folders: one or several; several form one calibration problem.
        rig: used instead of the rig in the folder or bag.
        frames: which to keep, see :meth:`Dataset.select`; all if None. Those left out may lack
            images.
        bag: how ROS bags are read; its tolerance is also that of names that are stamps.
        interval_s: between neighbouring clouds of folders, all of one drive: the motion of the
            LiDAR is then found by registration of neighbours, where it is needed.

    Raises:
        FileError, DatasetError: if a folder is missing, frames do not pair up, or the folders'
            rigs differ.
        ValueError: if ``frames`` selects nothing, or is no selection; or if ``bag`` is given
            without a bag, or ``interval_s`` is not within 0.005 to 10.
    """
    if interval_s is not None and not LEAST_INTERVAL_S <= interval_s <= MOST_INTERVAL_S:
        raise ValueError(
            f"--interval-s {interval_s:g}: neighbouring clouds are {LEAST_INTERVAL_S:g} to "
            f"{MOST_INTERVAL_S:g} s apart, 0.1 of a LiDAR with 10 Hz; give seconds"
        )
    if isinstance(folders, (str, Path)):
        folders = [folders]
    paths = tuple(Path(folder) for folder in folders)
    _require_folders(paths, bag)
    if interval_s is not None and all(map(is_bag, paths)):
        raise ValueError("interval_s is of folders; messages have stamps: give --motion scans")
    bag = replace(bag or BagOptions(), beside=tuple(path for path in paths if is_bag(path)))
    bare = {path for path in bag.beside if len(paths) > 1 and not Bag(path).of_type(*CLOUDS)}
    data = _without_frames(tuple(path for path in paths if path not in bare) or paths, rig, bag)
    notes = [*data.notes, *(f"{path}: has no clouds; it serves the other bags"
                            for path in sorted(bare))]  # fmt: skip
    chosen, recorded, late_s = list[Frame](), list[Frame](), list[Mapping[str, Array]]()
    for path in data.folders:
        prefix = f"{path.name}/" if len(data.folders) > 1 else ""
        start = 1 + max((frame.index for frame in recorded), default=-1)
        found = (
            frames_of_bag(path, data.rig.cameras, bag, lidars=data.rig.all_lidars, start=start,
                          prefix=prefix) if is_bag(path)
            else _frames_of_files(path, data.rig, start, prefix, complete=frames is None,
                                  tolerance_s=bag.sync_tolerance_s, interval_s=interval_s)
        )  # fmt: skip
        chosen += found.chosen
        recorded += found.recorded
        notes += found.notes
        late_s += [found.late_s] if found.late_s else []
    if late_s:
        data, of_times = _with_delays(data, late_s)
        notes += of_times
    others = () if recorded == chosen else tuple(recorded)
    data = replace(data, frames=tuple(chosen), recorded=others, notes=tuple(notes))
    data = data if frames is None else _complete(data.select(frames))
    of_cloud = data.frames[0].describe_cloud() if data.frames and data.rig.cameras else ()
    return replace(data, notes=(*of_cloud, *data.notes))


def _with_delays(data: Dataset, late_s: Sequence[Mapping[str, Array]]) -> tuple[Dataset, list[str]]:
    """The dataset with time offsets of cameras, by stamps, that its rig does not state; a note."""
    cameras, found = dict(data.rig.cameras), []
    for name, camera in cameras.items():
        median_s = round(float(np.median(np.concatenate([of[name] for of in late_s]))), 6)
        if camera.time_offset_s is None and median_s:
            cameras[name] = camera.model_copy(update={"time_offset_s": median_s})
            found.append(f"{name} {1e3 * median_s:+.1f} ms")
    rig = data.rig.model_copy(update={"cameras": cameras})
    note = f"time_offset_s by the stamps, after the corrected clouds: {', '.join(found)}"
    return replace(data, rig=rig), [note] if found else []


def _without_frames(paths: tuple[Path, ...], rig: Rig | None, bag: BagOptions) -> Dataset:
    """The rig of all sources, which may differ in their extrinsics, and notes on it."""
    read = [read_rig(path, bag) if rig is None else (rig, ()) for path in paths]
    first = read[0][0]
    for path, (other, _) in zip(paths, read, strict=True):
        _require_same_lenses(paths[0], first, path, other)
    notes = [note for _, of_source in read for note in of_source]
    if rig is None and is_bag(paths[0]):
        notes = [*describe_rig(first), *doubtful_axes(first), *notes]
    return Dataset(rig=first, frames=(), folders=paths, notes=tuple(dict.fromkeys(notes)))


def _frames_of_files(
    path: Path, rig: Rig, start: int, prefix: str, *,
    complete: bool, tolerance_s: float, interval_s: float | None,
) -> FoundFrames:  # fmt: skip
    """The frames of a folder; the complete ones where names are stamps."""
    found, pairing = frames_of_folder(
        path, [*rig.cameras], lidars=rig.all_lidars, complete=complete, sync_tolerance_s=tolerance_s
    )
    stamps_ns = stated_stamps(path, len(found)) if rig.other_lidars else [None] * len(found)
    frames = tuple(
        replace(
            each,
            index=start + n,
            name=prefix + each.name,
            recorded_ns=stamps_ns[n],
            columns=rig.cloud_columns,
        )
        for n, each in enumerate(found)
        if not pairing or rig.cameras.keys() <= each.image_paths.keys()
    )
    late_s, notes = dict[str, Array](), [pairing] if pairing else []
    if interval_s is not None:
        frames = _driven(frames, interval_s)
        if frames and (sweep := frames[0].load_sweep()) is not None:
            frames, late_s = _corrected(frames, rig.cameras, sweep[1])
            notes.append(f"{path}: clouds are corrected for motion by the times of their points")
    return FoundFrames(frames, frames, tuple(notes), late_s)


def _corrected(
    frames: Sequence[Frame], cameras: Collection[str], times_s: Array
) -> tuple[tuple[Frame, ...], dict[str, Array]]:
    """Driven frames at the median stamp of their images, and how much later each image is.

    Where files do not state it, at the middle of (n,) times of points.
    """
    after_s = np.array([[frame.image_after_s(n) for n in cameras] for frame in frames], np.float64)
    to_s, late_s = np.full(len(frames), (times_s.min() + times_s.max()) / 2), dict[str, Array]()
    if after_s.size and np.isfinite(after_s).all():
        to_s = np.median(after_s, axis=1)
        late_s = dict(zip(cameras, (after_s - to_s[:, None]).T, strict=True))
    corrected = tuple(
        replace(frame, find_motion=cache(partial(_motion_to, frame, float(s))))
        for frame, s in zip(frames, to_s, strict=True)
    )
    return corrected, late_s


def _motion_to(frame: Frame, to_s: float) -> ScanMotion:
    return ScanMotion(tuple(np.asarray(frame.twist_per_s).tolist()), to_s)


def _driven(frames: Sequence[Frame], interval_s: float) -> tuple[Frame, ...]:
    """Frames of one drive, whose motion is that between neighbours.

    The usual step of the numbers that are their names is the interval: a missing cloud is seen.
    """
    stems = [frame.cloud_path.stem for frame in frames]
    numbered = all(map(str.isdecimal, stems))
    numbers = np.array([*map(int, stems)] if numbered else range(len(stems)), dtype=np.float64)
    steps = np.diff(numbers)
    times_s = interval_s * numbers / (np.median(steps) if len(steps) else 1.0)
    driven = []
    for place, one in enumerate(frames):
        near = [i for i in (place - 1, place + 1) if 0 <= i < len(frames)]
        beside = [(frames[i], float(times_s[i] - times_s[place])) for i in near]
        find = cache(partial(twist_by_scans, one, beside))
        driven.append(replace(one, find_twist=find))
    return tuple(driven)


def _complete(data: Dataset) -> Dataset:
    """The dataset, of whose frames that are not selected only complete ones are kept."""
    cameras = data.rig.cameras.keys()
    for frame in data.frames:
        for name in cameras - frame.image_paths.keys():
            raise DatasetError(
                f"{frame.cloud_path}: frame {frame.name!r} has a cloud but no image of camera "
                f"{name!r}; give both the same name, or choose other frames",
                camera=name,
                frame=frame.name,
            )
    recorded = (frame for frame in data.recorded if cameras <= frame.image_paths.keys())
    return replace(data, recorded=tuple(recorded))


def spread_out(items: Sequence[Item], most: int) -> list[Item]:
    """At most ``most`` of the items, evenly spread over them: neighbours look alike."""
    places = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return [items[place] for place in places]


def _require_folders(paths: Sequence[Path], bag: BagOptions | None) -> None:
    if not paths:
        raise ValueError("no dataset folder given")
    for number, path in enumerate(paths):
        if path.resolve() in {other.resolve() for other in paths[:number]}:
            raise DatasetError(f"{path}: is given twice, and its frames would count twice")
        if is_bag(path) or published_folder(path) or folder_layout(path)[0].is_dir():
            continue
        if not path.is_dir():
            unread = way_out(path) if path.is_file() else None
            raise FileError(
                path,
                unread
                or "no such folder or ROS bag; expected a dataset, KITTI, nuScenes, Argoverse or "
                "bag",
            )
        for recorded in (*path.glob("*.mcap"), *path.glob("*.db3")):
            raise FileError(
                path,
                f"has no metadata.yaml, as a ROS 2 bag that was not closed; name {recorded.name}, "
                f"or write the file with `{REPAIR_ROS2.format(quote(str(path)))}`",
            )
    of_bags = bag is not None and replace(bag, sync_tolerance_s=NEAR_S) != BagOptions()
    if of_bags and not any(map(is_bag, paths)):
        raise ValueError("options for ROS bags, such as --every-s, are given without a bag")


def _require_same_lenses(first: Path, rig: Rig, path: Path, other: Rig) -> None:
    """Check that two rigs differ in their extrinsics at most."""
    lenses = [
        {
            name: camera.model_dump(exclude={"T_camera_lidar", "covariance", "frame_id", "mount"})
            for name, camera in r.cameras.items()
        }
        for r in (rig, other)
    ]
    if lenses[0] != lenses[1]:
        raise DatasetError(
            f"{path}: its cameras differ from those of {first} (names, sizes, intrinsics or image "
            "times); calibrate different rigs apart"
        )


MAX_BYTES = 300_000_000
"""Of all that is kept of a dataset: 300 gray images of a megapixel."""


def keep_frames(data: Dataset) -> Dataset:
    """The dataset with frames whose files are decoded once.

    Only the frames themselves, not the others that were recorded.
    """
    if any(frame.kept for frame in data.frames):
        return data
    kept = Kept(KeyedCache(MAX_BYTES), KeyedCache())
    return replace(data, frames=tuple(replace(frame, kept=kept) for frame in data.frames))


_COLOURS = (3, 4)  # channels


def dataset_from_arrays(
    rig: Rig,
    clouds: Sequence[ArrayLike],
    images: Mapping[str, Sequence[ArrayLike]],
    *,
    twists_per_s: ArrayLike | None = None,
) -> Dataset:
    """A dataset of arrays, to be calibrated without files. Images are not copied if they fit.

    Args:
        rig: lenses and the guess.
        clouds: per frame (n, 3) x y z or (n, 4) x y z intensity [m] in the LiDAR frame, or an array
            with such named fields; finite but for rows of NaN or zeros without a return.
        images: per camera and frame, (height, width, 3) BGR or (height, width) gray, uint8.
        twists_per_s: per frame, (6,) rotation [rad/s] and translation [m/s] of the LiDAR along its
            axes, if it moves and a time offset or read-out is to be estimated or known.

    Raises:
        DatasetError: if cameras, frames, shapes or values do not fit together.
    """
    if not isinstance(images, Mapping) or images.keys() != rig.cameras.keys():
        given = ", ".join(map(str, images)) if isinstance(images, Mapping) else "no camera by name"
        raise DatasetError(
            f"images are of {given or 'no camera'}, the rig has {', '.join(rig.cameras)}"
        )
    count = _count(clouds, "clouds")
    for name, of_camera in images.items():
        if (others := _count(of_camera, f"images[{name!r}]")) != count:
            raise DatasetError(
                f"{count} clouds, but {others} images of {name}; give one each per frame",
                camera=name,
            )
    if not count:
        raise DatasetError("no frame given")
    twists = None if twists_per_s is None else np.array(twists_per_s, dtype=np.float64)
    if twists is not None and not (twists.shape == (count, 6) and np.isfinite(twists).all()):
        raise DatasetError(f"twists_per_s: expected ({count}, 6) finite numbers, one row a frame")
    root = Path("arrays") / uuid.uuid4().hex[:8]  # caches tell frames apart by their paths
    frames = []
    for number in range(count):
        name = f"{number:06d}"
        cloud, paths = root / "lidar" / name, {camera: root / camera / name for camera in images}
        points = with_intensity(_cloud(clouds[number], number).points)
        arrays: dict[Path, NDArray[Any]] = {cloud: points} | {
            paths[camera]: _image(images[camera][number], lens, camera, number)
            for camera, lens in rig.cameras.items()
        }
        twist = None if twists is None else twists[number]
        frames.append(Frame(number, name, cloud, paths, twist=twist, arrays=arrays))
    return Dataset(
        rig=rig,
        frames=tuple(frames),
        folders=(root,),
        notes=tuple(describe_cloud("clouds[0]", _cloud(clouds[0], 0))),
    )


def _count(values: Sequence[ArrayLike], name: str) -> int:
    """The number of frames in a list of arrays."""
    if isinstance(values, np.ndarray) and values.ndim == 2:  # noqa: PLR2004
        found = f"one array of shape {values.shape}"
    elif hasattr(values, "__len__") and hasattr(values, "__getitem__"):
        return len(values)
    else:
        found = f"of type {type(values).__name__}"
    raise DatasetError(f"{name} is {found}, expected a list with an array per frame")


def _cloud(cloud: ArrayLike, number: int) -> RawCloud:
    name = f"clouds[{number}]"
    try:
        found = cloud_of_array(_array(cloud, name), name)
        return only_returns(found, name)
    except FileError as error:
        raise DatasetError(str(error), frame=number) from None


def _array(values: ArrayLike, name: str) -> NDArray[Any]:
    try:
        return np.asarray(values)
    except (ValueError, TypeError) as error:
        raise DatasetError(f"{name}: {error}; give an array") from None


def _image(image: ArrayLike, camera: Camera, name: str, number: int) -> NDArray[np.uint8]:
    where = f"images[{name!r}][{number}]"
    pixels = _array(image, where)
    gray = pixels.ndim == 2  # noqa: PLR2004
    shape = (camera.height_px, camera.width_px)
    known = gray or (pixels.ndim == len(_COLOURS) + 1 and pixels.shape[2] in _COLOURS)
    if pixels.dtype != np.uint8 or not known or pixels.shape[:2] != shape:
        raise DatasetError(
            f"{where} has shape {pixels.shape} of {pixels.dtype}, expected {(*shape, 3)} or "
            f"{shape} of uint8, as the rig gives its size",
            camera=name,
            frame=number,
        )
    return np.asarray(
        cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if gray else pixels[:, :, :3], np.uint8
    )

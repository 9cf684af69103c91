"""A rig with a guess per camera: by words, by a file, or by a search over all headings.

The search is for cameras without any guess, by images and clouds.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any, Literal

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, RigError
from calibgraph.guessing.mounting import GRAMMAR, Forward, Mounting, check_forward, parse_mounting
from calibgraph.io.dataset import Dataset, load_dataset, spread_out
from calibgraph.io.formats.rig_import import read_rig_parts
from calibgraph.io.rig_parts import RigParts
from calibgraph.io.rigs import describe_rig
from calibgraph.matching.burnt_in import hide_burnt_in
from calibgraph.matching.same_images import require_different_images
from calibgraph.matching.structure.acceptance import least_z_score
from calibgraph.matching.structure.bodies import Body, lead, place
from calibgraph.matching.structure.frame_cache import FrameCache, load_camera_frames
from calibgraph.matching.structure.global_search import ALONE
from calibgraph.matching.structure.matcher import MAX_SEARCH_DEG, MAX_SEARCH_M, SEARCH_FRAMES
from calibgraph.matching.structure.pose_search import PoseSearch, SearchRange
from calibgraph.model.geometry import camera_center
from calibgraph.model.rig import Rig
from calibgraph.parallel import core_pool
from calibgraph.progress import Progress, no_progress

Source = Literal["words", "pair", "file", "search"]

FILE_DEG, FILE_M = 3.0, 0.05
"""Of extrinsics in files, as a URDF's: drawings, and how exactly cameras are put up; chosen."""
FOUND_DEG, FOUND_M = 1.0, 0.15
"""Of cameras that the search found: they are nearer in benchmarks/notes/accuracy.md, where the
frames of one place err together."""
SIGMAS = 2.0  # of the guess, which the search of a calibration has to reach


HEADINGS_DEG = tuple(range(0, 360, 30))
RANGE = SearchRange(float(np.radians(20.0)), 1.5)
"""About each heading: neighbours overlap."""


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """The best pose of a camera over all headings.

    Attributes:
        T_camera_lidar: (4, 4).
        z_score: agreement of images and clouds there, in standard deviations of chance agreement.
        needed: the z-score from which on that is no chance agreement.
        seen_by: the camera that placed it, where one that was found before sees the same.
    """

    T_camera_lidar: Array
    z_score: float
    needed: float
    seen_by: str | None = None

    @property
    def accepted(self) -> bool:
        """Whether the camera was found."""
        return self.z_score >= self.needed


@dataclass(frozen=True)
class CameraGuess:
    """Where a guess is from, and how good it is.

    Attributes:
        source: words, the relative pose to a camera that has words, a file, or the search over all
            headings.
        rotation_sigma_deg: one standard deviation, of the worst axis.
        translation_sigma_m: the same.
        z_score: of the search; None of the others.
        text: how that is, in words.
    """

    source: Source
    rotation_sigma_deg: float
    translation_sigma_m: float
    text: str
    z_score: float | None = None


@dataclass(frozen=True, eq=False)
class RigGuess:
    """A rig to begin a calibration with.

    Attributes:
        rig: with the guess as its extrinsics.
        cameras: how good each is.
    """

    rig: Rig
    cameras: Mapping[str, CameraGuess] = field(default_factory=dict)

    @property
    def search_deg(self) -> float:
        """The range of rotation that a calibration should search, per axis [deg]."""
        widest = max(camera.rotation_sigma_deg for camera in self.cameras.values())
        return float(min(MAX_SEARCH_DEG, math.ceil(SIGMAS * widest)))

    @property
    def search_m(self) -> float:
        """The same of the translation [m]."""
        widest = max(camera.translation_sigma_m for camera in self.cameras.values())
        return min(MAX_SEARCH_M, math.ceil(10 * SIGMAS * widest) / 10)

    @property
    def lines(self) -> list[str]:
        """A line per camera with its pose, source and accuracy; then advice."""
        where = describe_rig(self.rig)
        return [
            *(f"{sentence}; {guess.text}; 1 sigma: {guess.rotation_sigma_deg:.2g} deg, "
              f"{guess.translation_sigma_m:.2g} m"
              for sentence, guess in zip(where, self.cameras.values(), strict=False)),
            f"calibrate with --search-deg {self.search_deg:g} --search-m {self.search_m:g}",
        ]  # fmt: skip

    def to_mapping(self) -> dict[str, Any]:
        """As plain values, without the rig."""
        cameras = {name: vars(guess) for name, guess in self.cameras.items()}
        return {"cameras": cameras, "search_deg": self.search_deg, "search_m": self.search_m}

    def save(self, path: Path | str) -> None:
        """Write the rig file, with the lines as comments."""
        self.rig.save(path, first_line="\n".join(f"# {line}" for line in self.lines))


def guess_rig(
    files: RigParts | Sequence[Path | str],
    *,
    mountings: Mapping[str, str] | None = None,
    data: Path | str | Sequence[Path | str] | None = None,
    search: Sequence[str] = (),
    forward: str = "+x",
    size_px: tuple[int, int] | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
) -> RigGuess:
    """Guess the extrinsics of a rig: from words first, then from files, else by a search.

    A camera that a relative pose in a file (Kalibr's T_cn_cnm1) ties to one with words is placed by
    it, if no file has its extrinsic.

    Args:
        files: with the lenses, and extrinsics as far as they are known, as of :func:`import_rig`;
            or what :func:`calibgraph.io.formats.rig_import.read_rig_parts` returns.
        mountings: per camera, words such as "rear-left 60 deg right, 0.4 m ahead of the LiDAR".
        data: images and clouds, in which cameras of which nothing is known are searched for over
            all headings; None for no search.
        search: cameras to search for although a file has an extrinsic.
        forward: the axis of the LiDAR frame that points ahead: +x, -x, +y or -y; z is up.
        size_px: width and height of images whose file has none.
        seed: of the search.
        progress: called as the search goes on.

    Raises:
        ValueError: if ``forward`` is no axis.
        CalibrationError: if words are not understood, or a camera has no guess or is not found.
    """
    axis = check_forward(forward)
    parts = files if isinstance(files, RigParts) else read_rig_parts(files)
    words = {name: parse_mounting(text, name) for name, text in (mountings or {}).items()}
    _require_cameras(parts, words, search)
    said = {name: mounting.T_camera_lidar(axis) for name, mounting in words.items()}
    missing = [n for n in parts.lenses if n in search or n not in {**said, **parts.T_camera_lidar}]
    tied = {
        name: (to, T_camera_lidar)
        for to, T in reversed(said.items())  # the first, if several
        for name, T_camera_lidar in parts.tied_to({to: T}).items()
        if name in missing and name not in search
    }
    unknown = [name for name in missing if name not in tied]
    if unknown and data is None:
        raise RigError(
            f"camera {unknown[0]!r}: nothing says where it is; describe it with "
            f"--mount {quote(unknown[0])}=WORDS ({GRAMMAR}), add a URDF or a sensor kit, or give "
            "--dataset to search over all headings",
            camera=unknown[0],
        )
    level = {name: Mounting(0.0).T_camera_lidar(axis) for name in unknown}
    placed = {name: T for name, (_, T) in tied.items()}
    rig = parts.to_rig({**said, **placed, **level}, size_px=size_px)
    found: dict[str, FoundCamera] = {}
    if unknown and data is not None:
        dataset = load_dataset(data, rig)
        require_different_images(dataset, rig)
        dataset = hide_burnt_in(dataset, rig)
        found = search_headings(dataset, rig, unknown, forward=axis, seed=seed, progress=progress)
        _require_found(found)
    rig = rig.moved_to({name: one.T_camera_lidar for name, one in found.items()})
    known = {
        name: CameraGuess("words", one.rotation_sigma_deg, one.translation_sigma_m, "by words")
        for name, one in words.items()
    }
    for name, (to, T) in tied.items():  # its rotation error moves the camera at a distance
        deg, apart_m = known[to].rotation_sigma_deg, camera_center(T) - camera_center(said[to])
        shift_m = float(np.linalg.norm(apart_m)) * math.radians(deg)
        metres = math.hypot(known[to].translation_sigma_m, shift_m)
        known[name] = CameraGuess("pair", deg, metres, f"by its pose to {to}")
    for name, one in found.items():
        seen = f", as {one.seen_by} sees it" if one.seen_by else ""
        text = f"found with a z-score of {one.z_score:.1f}{seen}"
        known[name] = CameraGuess("search", FOUND_DEG, FOUND_M, text, one.z_score)
    by_file = CameraGuess("file", FILE_DEG, FILE_M, "by a file")
    return RigGuess(rig, {name: known.get(name, by_file) for name in rig.cameras})


def _require_cameras(parts: RigParts, words: Mapping[str, Mounting], search: Sequence[str]) -> None:
    for name in (*words, *search):
        if name not in parts.lenses:
            raise RigError(
                f"no camera {name!r}; the files have {', '.join(parts.lenses)}", camera=name
            )
    for name in search:
        if name in words:
            raise RigError(
                f"camera {name!r} is both described and to be searched for; choose one", camera=name
            )


def _require_found(found: Mapping[str, FoundCamera]) -> None:
    missed = {name: one for name, one in found.items() if not one.accepted}
    if missed:
        scores = ", ".join(f"{n!r} ({one.z_score:.1f})" for n, one in missed.items())
        least = min(one.needed for one in missed.values())
        raise CalibrationError(
            f"not found at any heading: {scores}; a z-score of {least:.1f} is needed; describe "
            "them with --mount NAME=WORDS, or give frames of other places"
        )


def search_headings(
    dataset: Dataset,
    rig: Rig,
    cameras: Iterable[str],
    *,
    forward: Forward = "+x",
    seed: int = 0,
    progress: Progress = no_progress,
) -> dict[str, FoundCamera]:
    """Find cameras without a guess: only the lens is known, and that images are upright.

    One after another, over headings all round, each within 20 degrees and 1.5 m per axis of a level
    camera at the LiDAR. Those that are found place others that see the same.

    Raises:
        FileError: if an image or a cloud cannot be read.
    """
    names = list(cameras)
    lenses = {name: rig.cameras[name] for name in names}
    only = Rig(lidar=rig.lidar, cameras=lenses)
    found: dict[str, FoundCamera] = {}
    with core_pool() as cores:
        chosen = spread_out(dataset.frames, SEARCH_FRAMES)
        frames = load_camera_frames(FrameCache(), chosen, only, cores)
        search = PoseSearch(only, frames, RANGE, seed=seed, out_of_time=lambda: False)
        for index, name in enumerate(names):
            body = {name: lenses[name]}
            starts = [Mounting(float(deg)).T_camera_lidar(forward) for deg in HEADINGS_DEG]
            seen = _place_by_others(search, body, found)
            candidates = []
            for number, start in enumerate([] if seen else starts):
                done = index * len(starts) + number
                progress(f"searching all headings: {name}", done, len(names) * len(starts))
                candidates.append(search.with_roll(place(body, start), 0.0, effort=1))
            if seen is None:
                best = max(candidates, key=lambda candidate: candidate.z_score)
                T, needed = lead(best.body).T_camera_lidar, least_z_score(len(candidates))
                seen = FoundCamera(T, best.z_score, needed)
            found[name] = seen
    return found


def _place_by_others(
    search: PoseSearch, body: Body, found: dict[str, FoundCamera]
) -> FoundCamera | None:
    """The camera where one that was found sees it; None if that is not accepted."""
    for by, other in found.items():
        if not other.accepted:
            continue
        seen = search.seen_by({by: search.rig.cameras[by].moved_to(other.T_camera_lidar)}, body)
        if seen is None:
            continue
        candidate = search.at(seen)
        placed = FoundCamera(
            lead(candidate.body).T_camera_lidar, candidate.z_score, least_z_score(ALONE), by
        )
        if placed.accepted:
            return placed
    return None

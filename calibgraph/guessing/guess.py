"""A rig with a guess per camera: by words, by a file, or by a search over all headings.

The search is for cameras without any guess, by images and clouds.
"""

import math
from collections.abc import Collection, Mapping, Sequence
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
from calibgraph.matching.structure.pose_refinement import Candidate
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


Guess = tuple[Array, CameraGuess]
"""(4, 4) T_camera_lidar, and how good it is."""


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
    known: dict[str, Guess] = {
        name: (
            one.T_camera_lidar(axis),
            CameraGuess("words", one.rotation_sigma_deg, one.translation_sigma_m, "by words"),
        )
        for name, one in words.items()
    }
    missing = [n for n in parts.lenses if n in search or n not in {**words, **parts.T_camera_lidar}]
    tied = _tied_to(known, parts, [name for name in missing if name not in search])
    known |= tied
    unknown = [name for name in missing if name not in tied]
    if unknown and data is None:
        raise RigError(
            f"camera {unknown[0]!r}: nothing says where it is; describe it with "
            f"--mount {quote(unknown[0])}=WORDS ({GRAMMAR}), add a URDF or a sensor kit, or give "
            "--dataset to search over all headings",
            camera=unknown[0],
        )
    level = dict.fromkeys(unknown, Mounting(0.0).T_camera_lidar(axis))
    rig = parts.to_rig({**level, **{n: T for n, (T, _) in known.items()}}, size_px=size_px)
    if unknown and data is not None:
        dataset = load_dataset(data, rig)
        require_different_images(dataset, rig)
        dataset = hide_burnt_in(dataset, rig)
        found = search_headings(dataset, rig, unknown, forward=axis, seed=seed, progress=progress)
        rig, known = rig.moved_to({name: T for name, (T, _) in found.items()}), known | found
    by_file = CameraGuess("file", FILE_DEG, FILE_M, "by a file")
    return RigGuess(rig, {n: known[n][1] if n in known else by_file for n in rig.cameras})


def _tied_to(
    known: Mapping[str, Guess], parts: RigParts, names: Collection[str]
) -> dict[str, Guess]:
    """Cameras that relative poses tie to one that is known; to the first, if several."""
    tied: dict[str, Guess] = {}
    for to, (T_to, guess) in known.items():
        for name, T in parts.tied_to({to: T_to}).items():
            if name not in names or name in tied:
                continue
            # The rotation error of the one moves the other at a distance.
            apart_m = float(np.linalg.norm(camera_center(T) - camera_center(T_to)))
            shift_m = apart_m * math.radians(guess.rotation_sigma_deg)
            metres = math.hypot(guess.translation_sigma_m, shift_m)
            text = f"by its pose to {to}"
            tied[name] = T, CameraGuess("pair", guess.rotation_sigma_deg, metres, text)
    return tied


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


def search_headings(
    dataset: Dataset,
    rig: Rig,
    cameras: Sequence[str],
    *,
    forward: Forward = "+x",
    seed: int = 0,
    progress: Progress = no_progress,
) -> dict[str, Guess]:
    """Find cameras without a guess: only the lens is known, and that images are upright.

    One after another, over headings all round, each within 20 degrees and 1.5 m per axis of a level
    camera at the LiDAR. Those that are found place others that see the same.

    Raises:
        FileError: if an image or a cloud cannot be read.
        CalibrationError: if a camera is not found.
    """
    only = Rig(lidar=rig.lidar, cameras={name: rig.cameras[name] for name in cameras})
    needed, starts = least_z_score(len(HEADINGS_DEG)), len(HEADINGS_DEG)
    found: dict[str, Guess] = {}
    missed: list[str] = []
    with core_pool() as cores:
        chosen = spread_out(dataset.frames, SEARCH_FRAMES)
        frames = load_camera_frames(FrameCache(), chosen, only, cores)
        search = PoseSearch(only, frames, RANGE, seed=seed, out_of_time=lambda: False)
        for index, (name, lens) in enumerate(only.cameras.items()):
            placed = _place_by_others(search, {name: lens}, found)
            if placed is not None:
                found[name] = placed
                continue
            candidates = []
            for number, deg in enumerate(HEADINGS_DEG):
                done, total = index * starts + number, starts * len(cameras)
                progress(f"searching all headings: {name}", done, total)
                body = place({name: lens}, Mounting(float(deg)).T_camera_lidar(forward))
                candidates.append(search.with_roll(body, 0.0, effort=1))
            best = max(candidates, key=lambda candidate: candidate.z_score)
            if best.z_score >= needed:
                found[name] = _found(best)
            else:
                missed.append(f"{name!r} ({best.z_score:.1f})")
    if missed:
        raise CalibrationError(
            f"not found at any heading: {', '.join(missed)}; a z-score of {needed:.1f} is needed; "
            "describe them with --mount NAME=WORDS, or give frames of other places"
        )
    return found


def _found(candidate: Candidate, by: str | None = None) -> Guess:
    seen = f", as {by} sees it" if by else ""
    text = f"found with a z-score of {candidate.z_score:.1f}{seen}"
    guess = CameraGuess("search", FOUND_DEG, FOUND_M, text, candidate.z_score)
    return lead(candidate.body).T_camera_lidar, guess


def _place_by_others(search: PoseSearch, body: Body, found: Mapping[str, Guess]) -> Guess | None:
    """The camera where one that was found sees it; None if that is not accepted."""
    for by, (T, _) in found.items():
        seen = search.seen_by({by: search.rig.cameras[by].moved_to(T)}, body)
        candidate = None if seen is None else search.at(seen)
        if candidate is not None and candidate.z_score >= least_z_score(ALONE):
            return _found(candidate, by)
    return None

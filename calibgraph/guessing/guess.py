"""A rig with a guess per camera: by words, by a file, or by a search over all headings."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any, Literal

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, RigError
from calibgraph.guessing.heading_search import FoundCamera, search_headings
from calibgraph.guessing.mounting import GRAMMAR, Mounting, check_forward, parse_mounting
from calibgraph.io.dataset import load_dataset
from calibgraph.io.formats.rig_import import read_rig_parts
from calibgraph.io.rig_parts import RigParts
from calibgraph.io.rigs import describe_rig
from calibgraph.matching.burnt_in import hide_burnt_in
from calibgraph.matching.same_images import require_different_images
from calibgraph.matching.structure.matcher import MAX_SEARCH_DEG, MAX_SEARCH_M
from calibgraph.model.geometry import camera_center
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress, no_progress

Source = Literal["words", "pair", "file", "search"]

FILE_DEG, FILE_M = 3.0, 0.05
"""Of extrinsics in files, as a URDF's: drawings, and how exactly cameras are put up; chosen."""
FOUND_DEG, FOUND_M = 1.0, 0.15
"""Of cameras that the search found: they are nearer in benchmarks/notes/accuracy.md, where the
frames of one place err together."""
SIGMAS = 2.0  # of the guess, which the search of a calibration has to reach


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
    tied = _tied_cameras(parts, said, set(missing) - set(search))
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
    known |= {name: _by_pair(known[to], said[to], to, T) for name, (to, T) in tied.items()}
    known |= {name: _by_search(one) for name, one in found.items()}
    by_file = CameraGuess("file", FILE_DEG, FILE_M, "by a file")
    return RigGuess(rig, {name: known.get(name, by_file) for name in rig.cameras})


def _tied_cameras(
    parts: RigParts, said: Mapping[str, Array], names: Collection[str]
) -> dict[str, tuple[str, Array]]:
    """The cameras that a relative pose ties to one with words, to the first if to several.

    With the name of the other, and their own T_camera_lidar.
    """
    tied: dict[str, tuple[str, Array]] = {}
    for to, T in said.items():
        for name, T_camera_lidar in parts.tied_to({to: T}).items():
            if name in names and name not in tied:
                tied[name] = to, T_camera_lidar
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


def _require_found(found: Mapping[str, FoundCamera]) -> None:
    missed = {name: one for name, one in found.items() if not one.accepted}
    if missed:
        scores = ", ".join(f"{n!r} ({one.z_score:.1f})" for n, one in missed.items())
        least = min(one.needed for one in missed.values())
        raise CalibrationError(
            f"not found at any heading: {scores}; a z-score of {least:.1f} is needed; describe "
            "them with --mount NAME=WORDS, or give frames of other places"
        )


def _by_pair(other: CameraGuess, T_other_lidar: Array, to: str, T: Array) -> CameraGuess:
    """The other's sigmas, with its rotation error times the distance added to the translation."""
    apart_m = float(np.linalg.norm(camera_center(T) - camera_center(T_other_lidar)))
    shift_m = apart_m * math.radians(other.rotation_sigma_deg)
    translation_m = math.hypot(other.translation_sigma_m, shift_m)
    return CameraGuess("pair", other.rotation_sigma_deg, translation_m, f"by its pose to {to}")


def _by_search(one: FoundCamera) -> CameraGuess:
    seen = f", as {one.seen_by} sees it" if one.seen_by else ""
    text = f"found with a z-score of {one.z_score:.1f}{seen}"
    return CameraGuess("search", FOUND_DEG, FOUND_M, text, one.z_score)

"""A rig with a guess per camera: by words, or by files of other programs."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any, Literal

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import RigError
from calibgraph.guessing.mounting import GRAMMAR, check_forward, parse_mounting
from calibgraph.io.formats.rig_import import read_rig_parts
from calibgraph.io.rig_parts import RigParts
from calibgraph.io.rigs import describe_rig
from calibgraph.matching.structure.matcher import MAX_SEARCH_DEG, MAX_SEARCH_M
from calibgraph.model.geometry import camera_center
from calibgraph.model.rig import Rig

Source = Literal["words", "pair", "file"]

FILE_DEG, FILE_M = 3.0, 0.05
"""Of extrinsics in files, as a URDF's: drawings, and how exactly cameras are put up; chosen."""
SIGMAS = 2.0  # of the guess, which the search of a calibration has to reach


@dataclass(frozen=True)
class CameraGuess:
    """Where a guess is from, and how good it is.

    Attributes:
        source: words, the relative pose to a camera that has words, or a file.
        rotation_sigma_deg: one standard deviation, of the worst axis.
        translation_sigma_m: the same.
        text: how that is, in words.
    """

    source: Source
    rotation_sigma_deg: float
    translation_sigma_m: float
    text: str


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
    forward: str = "+x",
    size_px: tuple[int, int] | None = None,
) -> RigGuess:
    """Guess the extrinsics of a rig: from words first, then from files.

    A camera that a relative pose in a file (Kalibr's T_cn_cnm1) ties to one with words is placed by
    it, if no file has its extrinsic.

    Args:
        files: with the lenses, and extrinsics as far as they are known, as of :func:`import_rig`;
            or what :func:`calibgraph.io.formats.rig_import.read_rig_parts` returns.
        mountings: per camera, words such as "rear-left 60 deg right, 0.4 m ahead of the LiDAR".
        forward: the axis of the LiDAR frame that points ahead: +x, -x, +y or -y; z is up.
        size_px: width and height of images whose file has none.

    Raises:
        ValueError: if ``forward`` is no axis.
        CalibrationError: if words are not understood, or a camera has no guess.
    """
    axis = check_forward(forward)
    parts = files if isinstance(files, RigParts) else read_rig_parts(files)
    words = {name: parse_mounting(text, name) for name, text in (mountings or {}).items()}
    for name in words:
        if name not in parts.lenses:
            raise RigError(
                f"no camera {name!r}; the files have {', '.join(parts.lenses)}", camera=name
            )
    known: dict[str, Guess] = {
        name: (
            one.T_camera_lidar(axis),
            CameraGuess("words", one.rotation_sigma_deg, one.translation_sigma_m, "by words"),
        )
        for name, one in words.items()
    }
    missing = [name for name in parts.lenses if name not in {**words, **parts.T_camera_lidar}]
    known |= _tied_to(known, parts, missing)
    for name in (name for name in missing if name not in known):
        raise RigError(
            f"camera {name!r}: nothing says where it is; describe it with "
            f"--mount {quote(name)}=WORDS ({GRAMMAR}), or add a URDF or a sensor kit",
            camera=name,
        )
    rig = parts.to_rig({n: T for n, (T, _) in known.items()}, size_px=size_px)
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

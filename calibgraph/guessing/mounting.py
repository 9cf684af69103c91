"""Mountings and lenses in words.

"rear-left 60 deg right, 20 deg down, 0.4 m ahead of the LiDAR"; "90 deg", a horizontal field of
view, or "4 mm 3 um" of a spec sheet.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import RigError
from calibgraph.model.geometry import T_OPTICAL_LINK, invert, transform
from calibgraph.model.lens import IN_DOUBT
from calibgraph.model.rig import Camera, Intrinsics

Forward = Literal["+x", "-x", "+y", "-y"]

HEADINGS: Mapping[str, float] = {
    "front": 0.0, "front-left": 45.0, "left": 90.0, "rear-left": 135.0, "rear": 180.0,
    "rear-right": -135.0, "right": -90.0, "front-right": -45.0,
    "back": 180.0, "back-left": 135.0, "back-right": -135.0,
}  # fmt: skip
"""Degrees to the left of ahead."""
_TURNS: Mapping[str, tuple[str, float]] = {
    "left": ("heading", 1.0), "right": ("heading", -1.0), "down": ("tilt", 1.0),
    "up": ("tilt", -1.0), "clockwise": ("roll", 1.0), "counterclockwise": ("roll", -1.0),
}  # fmt: skip
_SIDES: Mapping[str, tuple[str, float]] = {
    "ahead": ("ahead", 1.0), "behind": ("ahead", -1.0), "left": ("left", 1.0),
    "right": ("left", -1.0), "above": ("up", 1.0), "below": ("up", -1.0),
}  # fmt: skip
_OF_LIDAR = (["of", "the", "lidar"], ["of", "lidar"], ["the", "lidar"], ["lidar"])
_UNITS_M: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_DEGREES = ("deg", "degrees", "degree")
_TOKEN = re.compile(r"\s*(\d+(?:\.\d+)?|\.\d+|[^\W\d_]+(?:-[^\W\d_]+)*|°|,|\S)")
GRAMMAR = (
    f"one of {', '.join(HEADINGS)} (add 'upside down' if so); NUMBER deg {'|'.join(_TURNS)}; "
    f"NUMBER m|cm|mm {'|'.join(_SIDES)} (of the LiDAR)"
)
_FORWARD_DEG: Mapping[Forward, float] = {"+x": 0.0, "+y": 90.0, "-x": 180.0, "-y": -90.0}

WORD_SIGMAS = {"heading": 10.0, "tilt": 3.0, "roll": 3.0, "ahead": 0.8, "left": 0.4, "up": 0.9}
"""Degrees and metres that the words leave open: root mean squares over 21 cameras of 8 recorded
vehicles about the nearest of the eight headings, level and at the LiDAR (8.2, 2.0, 0.9 deg; 0.72,
0.33, 0.85 m), rounded up."""
SAID_DEG, SAID_M, SAID_SHARE = 5.0, 0.05, 0.1
"""Sigmas of given numbers: chosen for estimates by eye; of a length, a constant and a share."""


@dataclass(frozen=True)
class Mounting:
    """How a camera is mounted, in a vehicle's axes at the LiDAR: x ahead, y left, z up.

    Attributes:
        heading_deg: of its axis, to the left of ahead.
        tilt_deg: of its axis, downwards.
        roll_deg: about its axis, clockwise as seen from behind the camera.
        place_m: (3,) ahead, left and up of the LiDAR.
        sigmas: standard deviations of all six [deg, m], by the names of ``WORD_SIGMAS``.
    """

    heading_deg: float
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigmas: Mapping[str, float] = field(default_factory=lambda: dict(WORD_SIGMAS))

    @property
    def rotation_sigma_deg(self) -> float:
        """The largest of the angles'."""
        return max(self.sigmas[name] for name in ("heading", "tilt", "roll"))

    @property
    def translation_sigma_m(self) -> float:
        """The largest of the place's."""
        return max(self.sigmas[name] for name in ("ahead", "left", "up"))

    def T_camera_lidar(self, forward: Forward = "+x") -> Array:
        """(4, 4) of the camera's optical frame."""
        angles = (self.heading_deg, self.tilt_deg, self.roll_deg)
        T_vehicle_link = transform(Rotation.from_euler("ZYX", angles, degrees=True), self.place_m)
        T_lidar_vehicle = transform(Rotation.from_euler("Z", _FORWARD_DEG[forward], degrees=True))
        T: Array = T_OPTICAL_LINK @ invert(T_lidar_vehicle @ T_vehicle_link)
        return T


def check_forward(text: str) -> Forward:
    """The axis of a text.

    Raises:
        ValueError: if it is none.
    """
    if text not in _FORWARD_DEG:
        raise ValueError(f"forward axis {text!r}: expected one of {', '.join(_FORWARD_DEG)}")
    return cast(Forward, text)


def parse_mounting(text: str, camera: str) -> Mounting:
    """Read how a camera is mounted.

    Raises:
        RigError: if a word is not understood, said twice, or the heading is missing.
    """
    values: dict[str, float] = {}
    words = [match[1] for match in _TOKEN.finditer(text.lower()) if match[1] != ","]
    for name, value in _read_items(words, text, camera):
        if name in values:
            raise _refusal(camera, text, f"gives the {name} twice")
        values[name] = value
    if "direction" not in values:
        raise _refusal(camera, text, "has no direction")
    said = values.keys()
    given = {name: values.get(name, 0.0) for name in WORD_SIGMAS}
    rolled = given["roll"] + values.get("turned", 0.0)
    return Mounting(
        heading_deg=(values["direction"] + given["heading"] + 180.0) % 360.0 - 180.0,
        tilt_deg=given["tilt"],
        roll_deg=rolled,
        place_m=(given["ahead"], given["left"], given["up"]),
        sigmas={name: sigma if name not in said
                else SAID_DEG if name in ("heading", "tilt", "roll")
                else math.hypot(SAID_M, SAID_SHARE * given[name])
                for name, sigma in WORD_SIGMAS.items()},
    )  # fmt: skip


def _read_items(words: list[str], text: str, camera: str) -> Iterator[tuple[str, float]]:
    """The items of a text: their names, and their values in degrees and metres."""
    while words:
        word = words.pop(0)
        if word == "and":
            continue
        if word in HEADINGS:
            yield "direction", HEADINGS[word]
        elif word == "upside" and words[:1] == ["down"]:
            words.pop(0)
            yield "turned", 180.0
        elif word[0].isdigit() or word[0] == ".":
            yield _read_number(float(word), words, text, camera)
        else:
            raise _refusal(camera, text, f"has {word!r}, which is not understood")


def _read_number(value: float, words: list[str], text: str, camera: str) -> tuple[str, float]:
    """A turn or a place; takes its words from the front of the list."""
    unit, side = [*words[:2], "", ""][:2]
    del words[:2]
    if unit in (*_DEGREES, "°") and side in _TURNS:
        name, sign = _TURNS[side]
        return name, sign * value
    if unit in _UNITS_M and side in _SIDES:
        end = next((k for k in _OF_LIDAR if words[: len(k)] == k), [])
        del words[: len(end)]
        name, sign = _SIDES[side]
        return name, sign * value * _UNITS_M[unit]
    said = " ".join(part for part in (f"{value:g}", unit, side) if part)
    raise _refusal(camera, text, f"has {said!r}, which is not understood")


def _refusal(camera: str, text: str, what: str) -> RigError:
    return RigError(f"camera {camera!r}: {text!r} {what}; understood are {GRAMMAR}", camera=camera)


CALIBRATION = "calibration"
LENS_GRAMMAR = (
    f"{CALIBRATION}; a horizontal field of view, as '90 deg'; or focal length and size of a pixel, "
    "as '4 mm 3 um'"
)
_NUMBER = r"(\d+(?:\.\d+)?|\.\d+)"
_FIELD_OF_VIEW = re.compile(rf"{_NUMBER} *(?:deg|degrees|°)")
_SPEC_SHEET = re.compile(rf"{_NUMBER} *mm[ ,]+{_NUMBER} *(?:um|µm)")
_MOST_DEG = 150.0
"""Of a lens without distortion; images of wider ones are curved, and need a calibration."""


def parse_lens(text: str, camera: str, size_px: tuple[int, int]) -> dict[str, Any] | None:
    """The lens of a camera's entry in a rig file, with how well it is known.

    Args:
        text: as of ``LENS_GRAMMAR``.
        camera: its name, for messages.
        size_px: width and height of the image.

    Returns:
        None of a calibration, whose numbers are to be filled in; else a lens without distortion,
        with the principal point in the middle.

    Raises:
        RigError: if it is not understood.
    """
    words = text.strip().lower()
    if words == CALIBRATION:
        return None
    width, height = size_px
    if found := _FIELD_OF_VIEW.fullmatch(words):
        degrees = float(found[1])
        if not 0 < degrees <= _MOST_DEG:
            raise RigError(
                f"camera {camera!r}: a field of view of {degrees:g} deg; of one over "
                f"{_MOST_DEG:g} deg the image is curved: calibrate the lens, and give "
                f"{CALIBRATION}",
                camera=camera,
            )
        focal_px = 0.5 * width / math.tan(math.radians(0.5 * degrees))
    elif (found := _SPEC_SHEET.fullmatch(words)) and float(found[2]) > 0 < float(found[1]):
        focal_px = 1000.0 * float(found[1]) / float(found[2])
    else:
        raise RigError(f"camera {camera!r}: lens {text!r}; expected {LENS_GRAMMAR}", camera=camera)
    f, centre = round(focal_px, 2), (0.5 * (width - 1), 0.5 * (height - 1))
    lens = Camera(
        width_px=width,
        height_px=height,
        intrinsics_px=Intrinsics(fx=f, fy=f, cx=centre[0], cy=centre[1]),
        T_camera_lidar=np.eye(4),
    )
    fields = "intrinsics_px", "distortion", "intrinsics_sigma_px", "distortion_sigma"
    stated = IN_DOUBT.state_in(lens).model_dump(mode="json")
    return {key: stated[key] for key in fields}

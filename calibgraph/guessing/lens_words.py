"""A lens in words: "90 deg", a horizontal field of view, or "4 mm 3 um" of a spec sheet."""

import math
import re
from typing import Any

import numpy as np

from calibgraph.errors import RigError
from calibgraph.model.lens import IN_DOUBT
from calibgraph.model.rig import Camera, Intrinsics

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

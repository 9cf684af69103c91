"""Other names of the lens models, in any spelling."""

import re
from collections.abc import Mapping
from typing import Final

from factors import LensModel

NAMES: Final[Mapping[LensModel, tuple[str, ...]]] = {
    "pinhole": (
        "pinhole", "plumb_bob", "radtan", "rational_polynomial", "radial_tangential", "radial",
        "rational", "brown", "brown_conrady", "perspective", "opencv", "full_opencv", "standard",
        "pinhole_radtan", "pinhole_radtan8", "pinhole_full", "pinhole_none", "none",
    ),
    "fisheye": (
        "fisheye", "equidistant", "equi", "kannala_brandt", "opencv_fisheye", "kannala_brandt4",
        "kannala_brandt8", "kb", "kb4", "kb8", "pinhole_equi", "pinhole_equidistant",
        "pinhole_fisheye", "equidistant_fisheye", "fisheye_equidistant",
    ),
    "omnidirectional": (
        "omnidirectional", "omni", "omnidir", "mei", "unified", "omni_radtan", "omni_none",
    ),
    "equirectangular": ("equirectangular", "panorama", "spherical", "equirect", "panoramic"),
}  # fmt: skip
"""Names of ROS, Kalibr, OpenCV, camodocal, COLMAP, Basalt, multical and others; the first is ours.
Capitals, hyphens, blanks and a `Camera` or `model` at the end do not count."""

KNOWN: Final = "; ".join(f"{model} ({', '.join(names[1:6])})" for model, names in NAMES.items())
"""The models and their commonest names, for messages."""


def plain_key(name: str) -> str:
    """A name without capitals and punctuation."""
    return re.sub(r"[\W_]", "", name.lower())


_MODELS = {plain_key(name): model for model, names in NAMES.items() for name in names}


def find_lens_model(name: str) -> LensModel | None:
    """The model here of a name that others give it; None if there is no such model here."""
    key = plain_key(name)
    return _MODELS.get(key) or _MODELS.get(re.sub(r"(camera|model|lens)+$", "", key) or key)

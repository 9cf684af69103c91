"""The kit of all pages: their frame, styles, scripts and macros; and pictures in them."""

import base64
from functools import cache

import cv2
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from numpy import uint8
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError, printable


@cache
def page_template(package: str) -> Template:
    """A package's page, which may use ``base.html.j2`` and ``macros.html.j2`` of the report."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(each, "") for each in (package, "calibgraph.report")]),
        autoescape=True,
        # Texts of others without characters that are not seen; markup is ours.
        finalize=lambda value: printable(value) if type(value) is str else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html.j2")


def encode(picture: NDArray[uint8], kind: str, *options: int) -> bytes:
    """A picture, BGR, as a file of this kind: png or jpeg."""
    done, data = cv2.imencode(f".{kind}", picture, options)
    if not done:
        raise CalibrationError(f"a picture of shape {picture.shape} cannot be encoded as {kind}")
    return data.tobytes()


def data_uri(data: bytes, kind: str = "png") -> str:
    """The file of a picture as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"

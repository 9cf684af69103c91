"""When the images of a camera are taken, as a rig file states it."""

from typing import Annotated

from pydantic import Field

from calibgraph.files import StrictNumbers

Seconds = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]
SecondsSigma = Annotated[float, Field(ge=1e-6, le=10)]


class ImageTimes(StrictNumbers):
    """When a camera takes its images, as far as it is known, and how well.

    ``time_offset_s``: how long after the points of a frame the middle row is taken. ``readout_s``:
    from the first row to the last, of a rolling shutter; negative where the last row is first.
    """

    time_offset_s: Seconds | None = None
    time_offset_sigma_s: SecondsSigma | None = None
    readout_s: Seconds | None = None
    readout_sigma_s: SecondsSigma | None = None


IMAGE_TIMES = tuple(ImageTimes.model_fields)

"""Matplotlib figures: size, axes, legend, PNG in a data URI or in a file."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from calibgraph.model.rig import Camera


WIDTH_IN = 4.4
_DPI = 150
_PALETTE_SIZE = 96  # colours of a picture; a palette makes it a third as large


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """An empty figure outside pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def image_figure(camera: Camera, right_in: float = 0.1) -> tuple[Figure, Axes]:
    """A figure whose axes are a camera's image, v downwards."""
    left_in, below_in, above_in = 0.45, 0.25, 0.3
    width_in = WIDTH_IN - left_in - right_in
    height_in = float(np.clip(width_in * camera.height_px / camera.width_px, 0.6, 5.0))
    full_in = below_in + height_in + above_in
    figure = new_figure(full_in)
    axes = figure.add_axes(
        (left_in / WIDTH_IN, below_in / full_in, width_in / WIDTH_IN, height_in / full_in)
    )
    axes.set(xlim=(-0.5, camera.width_px - 0.5), ylim=(camera.height_px - 0.5, -0.5))
    axes.set(aspect="equal")
    axes.tick_params(labelsize=8)
    return figure, axes


def to_data_uri(figure: Figure) -> str:
    """The figure as a PNG with a palette, in a data URI."""
    from PIL import Image

    figure.canvas.draw()
    rgb = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])  # type: ignore[attr-defined]
    buffer = io.BytesIO()
    # This method keeps colours that few pixels have: outliers are orange, and few.
    small = rgb.quantize(_PALETTE_SIZE, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    small.save(buffer, "PNG")
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"

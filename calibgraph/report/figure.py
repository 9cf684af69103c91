"""Matplotlib figures for the page: size, axes, legend, PNG in a data URI."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING, Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


WIDTH_IN = 4.4
_DPI = 150
_PALETTE_SIZE = 96  # colours of a picture; a palette makes it a third as large


def new_figure(height_in: float) -> Figure:
    """An empty figure outside pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def image_figure(camera: Camera, right_in: float = 0.1) -> tuple[Figure, Axes]:
    """A figure whose axes are the image, v downwards."""
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


def add_legend(axes: Axes, **where: Any) -> None:
    """Add a legend and a light grid."""
    axes.grid(color="0.92", linewidth=0.8)
    axes.set_axisbelow(True)
    style = {"loc": "upper right", "markerscale": 3, "framealpha": 0.85, **where}
    axes.legend(fontsize=8, borderpad=0.3, handlelength=1.4, **style)


def set_octave_ticks(axes: Axes, values: Array) -> None:
    """Label a logarithmic x axis at the powers of two within the range of the values."""
    from matplotlib.ticker import NullFormatter, NullLocator

    ticks = 2.0 ** np.arange(-3, 12)
    low, high = np.min(values, initial=1.0), np.max(values, initial=2.0)
    if len(values):
        low, high = values.min() / 1.1, values.max() * 1.1
    shown = ticks[(ticks >= low) & (ticks <= high)]
    axes.set_xlim(low, high)
    axes.set_xticks(shown, [f"{tick:g}" for tick in shown])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())

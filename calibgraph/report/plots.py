"""The report's diagrams, each a PNG in a data URI. None holds text of the user's."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.rig import Camera
from calibgraph.report.frame_errors import Errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

# Colours that differ for the colour-blind too (Okabe and Ito, "Color universal design").
_USED, _GATED, _LINE, _SECOND = "#0072B2", "#D55E00", "#000000", "#009E73"

_WIDTH_IN, _HEIGHT_IN, _DPI = 4.4, 3.1, 150
_SHADES = 96  # of a picture's palette, which makes it a third as large
_MOST_DOTS = 6000
_GATES_SHOWN = 2.0
_BINS = 15  # of the running median
_LEAST_IN_BIN = 10
_ARROW_CELLS = 12  # across the image
_LEAST_IN_CELL = 3
_COVER_CELLS = 20
_OCTAVES_M = (0.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, np.inf)
_OCTAVE_NAMES = ("< 2", "2-4", "4-8", "8-16", "16-32", "32-64", "> 64")
_NICE = np.array([1.0, 2.0, 5.0, 10.0])
_LEAST_MOVE = 1e-4  # deg or cm: what a logarithmic axis shows of nothing


def residual_scatter(errors: Errors, sigma_px: float) -> str:
    """Residuals in u and v, with the gate and one sigma."""
    figure = _figure(_WIDTH_IN, 3.3)
    axes = figure.add_axes((0.13, 0.15, 0.57, 0.76))  # a square; the legend is beside it
    limit = _GATES_SHOWN * errors.gate_px
    for part, colour, label in _in_and_out(errors):
        dots = _thinned(part.vectors_px)
        axes.plot(*dots.T, ".", color=colour, markersize=2.5, alpha=0.5, label=label)
    for radius, style, label in (
        (errors.gate_px, "-", f"gate\n{errors.gate_px:.2g} px"),
        (sigma_px, "--", f"1 sigma\n{sigma_px:.2g} px"),
    ):
        circle = radius * np.exp(1j * np.linspace(0, 2 * np.pi, 200))
        axes.plot(circle.real, circle.imag, style, color=_LINE, linewidth=1.2, label=label)
    axes.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal")
    axes.set(xlabel="du [px] (right)", ylabel="dv [px] (down)")
    far = int(np.count_nonzero(np.abs(errors.vectors_px).max(axis=1, initial=0.0) > limit))
    axes.set_title(f"{far} of {len(errors.frame)} are farther out than shown", fontsize=9)
    _with_legend(axes, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return _png(figure)


def residual_by_distance(errors: Errors) -> str:
    """Size of the residuals against the distance of the points, with its running median."""
    figure = _figure(_WIDTH_IN, 3.3)
    axes = figure.add_axes((0.12, 0.15, 0.85, 0.82))
    for part, colour, label in _in_and_out(errors):
        dots = _thinned(np.column_stack([part.distances_m, part.sizes_px]))
        axes.plot(*dots.T, ".", color=colour, markersize=2.5, alpha=0.5, label=label)
    middle = _running_median(errors.select(errors.inside))
    axes.plot(*middle.T, "-", color=_LINE, linewidth=1.8, label="median, inside")
    axes.axhline(errors.gate_px, color=_LINE, linewidth=1.0, linestyle=":")
    axes.set(xscale="log", ylim=(0, _GATES_SHOWN * errors.gate_px))
    axes.set(xlabel="distance from the camera [m]", ylabel="residual [px]")
    _plain_log(axes, errors.distances_m)
    _with_legend(axes)
    return _png(figure)


def residual_map(camera: Camera, errors: Errors) -> str:
    """Where the matches are, and the mean residual of each cell as an arrow."""
    figure, axes = _image_figure(camera)
    used = errors.select(errors.inside)
    axes.plot(*_thinned(used.pixels_px).T, ".", color=_USED, markersize=2, alpha=0.35)
    centres, means, cell_px = _cell_means(camera, used)
    factor = _arrow_factor(means, cell_px)
    axes.quiver(
        *centres.T, *(factor * means).T, angles="xy", scale_units="xy", scale=1.0,
        color=_GATED, width=0.005, headwidth=3.5, headlength=3.5, headaxislength=3, minshaft=2,
        zorder=3,
    )  # fmt: skip
    title = f"mean residual per cell, drawn {factor:g} times as long"
    axes.set_title(title if len(means) else "too few matches per cell for arrows", fontsize=9)
    return _png(figure)


def coverage(camera: Camera, errors: Errors) -> str:
    """How many used matches each cell of the image has."""
    from matplotlib.ticker import MaxNLocator

    figure, axes = _image_figure(camera, right_in=0.5)
    used = errors.select(errors.inside).pixels_px
    extent = ((-0.5, camera.width_px - 0.5), (-0.5, camera.height_px - 0.5))
    counts = _counts(used, camera, _cells(camera, _COVER_CELLS))
    shown = np.where(counts > 0, counts, np.nan)
    image = axes.imshow(
        shown, extent=(*extent[0], *extent[1][::-1]), cmap="YlGnBu", vmin=0,
        aspect="equal", interpolation="nearest",
    )  # fmt: skip
    empty = np.mean(counts == 0)
    axes.set_title(f"used matches per cell; {empty:.0%} of the cells have none", fontsize=9)
    beside = axes.inset_axes((1.015, 0.0, 0.025, 1.0))
    whole = MaxNLocator(4, integer=True)
    figure.colorbar(image, cax=beside, ticks=whole).ax.tick_params(labelsize=8)
    return _png(figure)


def distances(errors: Errors) -> str:
    """How many used matches lie at which distance."""
    figure = _figure(_WIDTH_IN, 2.5)
    axes = figure.add_axes((0.13, 0.18, 0.84, 0.79))
    counts, _ = np.histogram(errors.distances_m[errors.inside], bins=np.array(_OCTAVES_M))
    bars = axes.bar(_OCTAVE_NAMES, counts, color=_USED)
    axes.bar_label(bars, fontsize=8)
    axes.set(xlabel="distance from the camera [m]", ylabel="used matches")
    axes.margins(y=0.15)
    return _png(figure)


def error_bars(sigmas: Sequence[Array], bootstrap: Sequence[Array] | None) -> str:
    """One sigma per axis: rotation and translation, and the bootstrap's beside it.

    Args:
        sigmas: (3,) rotation [deg], (3,) translation [cm].
        bootstrap: the same of the bootstrap, or None.
    """
    figure = _figure(_WIDTH_IN, 2.5)
    places = ((0.19, 0.12, 0.29, 0.76), (0.68, 0.12, 0.29, 0.76))
    for index, (place, label) in enumerate(
        zip(places, ("rotation [deg]", "translation [cm]"), strict=True)
    ):
        axes = figure.add_axes(place)
        _bars(axes, sigmas[index], None if bootstrap is None else bootstrap[index])
        axes.set_ylabel(label, labelpad=2)
    if bootstrap is not None:
        figure.legend(*axes.get_legend_handles_labels(), loc="upper center", ncols=2,
                      frameon=False, fontsize=8)  # fmt: skip
    return _png(figure)


def _bars(axes: Axes, sigma: Array, other: Array | None) -> None:
    places = np.arange(3)
    shift = 0.0 if other is None else 0.13
    style: dict[str, Any] = {"fmt": "o", "capsize": 5, "elinewidth": 2, "markersize": 4}
    axes.errorbar(places - shift, np.zeros(3), sigma, color=_USED, label="by frames", **style)
    if other is not None:
        axes.errorbar(places + shift, np.zeros(3), other, color=_GATED, label="bootstrap", **style)
    axes.set_xticks(places, ["x", "y", "z"])
    axes.axhline(0, color="0.7", linewidth=0.8, zorder=0)
    axes.set_xlim(-0.6, 2.6)


def convergence(rounds: Sequence[Mapping[str, Any]]) -> str:
    """How far each round of matching moved the camera, and how many matches it had."""
    figure = _figure(_WIDTH_IN, 3.1)
    moved = figure.add_axes((0.15, 0.46, 0.82, 0.51))
    matches = figure.add_axes((0.15, 0.14, 0.82, 0.24), sharex=moved)
    numbers = np.arange(1, len(rounds) + 1)
    for key, style, colour, label in (
        ("moved_deg", "o-", _USED, "turned [deg]"),
        ("moved_cm", "s--", _GATED, "shifted [cm]"),
    ):
        values = np.maximum([r[key] for r in rounds], _LEAST_MOVE)
        moved.plot(numbers, values, style, color=colour, markersize=4, label=label)
    moved.set_yscale("log")
    moved.tick_params(labelbottom=False)
    _with_legend(moved, markerscale=1)
    matches.bar(numbers, [r["matches"] for r in rounds], color="0.6", width=0.6)
    matches.set(xlabel="round of matching", ylabel="matches")
    matches.set_xticks(numbers)
    figure.align_ylabels()
    return _png(figure)


def _figure(width_in: float, height_in: float) -> Figure:
    """An empty picture that no global state knows of."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _image_figure(camera: Camera, right_in: float = 0.1) -> tuple[Figure, Axes]:
    """Axes that are the image, v downwards, with so much room to the right."""
    left_in, below_in, above_in = 0.45, 0.25, 0.3
    width_in = _WIDTH_IN - left_in - right_in
    height_in = float(np.clip(width_in * camera.height_px / camera.width_px, 0.6, 5.0))
    full_in = below_in + height_in + above_in
    figure = _figure(_WIDTH_IN, full_in)
    axes = figure.add_axes(
        (left_in / _WIDTH_IN, below_in / full_in, width_in / _WIDTH_IN, height_in / full_in)
    )
    axes.set(xlim=(-0.5, camera.width_px - 0.5), ylim=(camera.height_px - 0.5, -0.5))
    axes.set(aspect="equal")
    axes.tick_params(labelsize=8)
    return figure, axes


def _png(figure: Figure) -> str:
    """The picture as a data URI, with a palette."""
    from PIL import Image

    figure.canvas.draw()
    shown = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])  # type: ignore[attr-defined]
    buffer = io.BytesIO()
    # The method that keeps colours that few pixels have: outliers are orange, and few.
    few = shown.quantize(_SHADES, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(buffer, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def _with_legend(axes: Axes, **where: Any) -> None:
    axes.grid(color="0.92", linewidth=0.8)
    axes.set_axisbelow(True)
    style = {"loc": "upper right", "markerscale": 3, "framealpha": 0.85, **where}
    axes.legend(fontsize=8, borderpad=0.3, handlelength=1.4, **style)


def _in_and_out(errors: Errors) -> tuple[tuple[Errors, str, str], tuple[Errors, str, str]]:
    """The matches beyond the gate and those inside it, with colour and label."""
    outside, inside = errors.select(~errors.inside), errors.select(errors.inside)
    return (
        (outside, _GATED, f"{len(outside.frame)} beyond"),
        (inside, _USED, f"{len(inside.frame)} inside"),
    )


def _thinned(dots: Array) -> Array:
    """At most _MOST_DOTS of the rows, evenly spread: more cannot be told apart."""
    rows = np.linspace(0, len(dots) - 1, min(len(dots), _MOST_DOTS)).round().astype(int)
    return np.asarray(dots[rows])


def _running_median(errors: Errors) -> Array:
    """(m, 2) medians of distance and size over runs of equally many matches."""
    order = np.argsort(errors.distances_m)
    runs = np.array_split(order, max(1, min(_BINS, len(order) // _LEAST_IN_BIN)))
    medians = [
        (np.median(errors.distances_m[run]), np.median(errors.sizes_px[run]))
        for run in runs
        if len(run)
    ]
    return np.array(medians).reshape(-1, 2)


def _plain_log(axes: Axes, values: Array) -> None:
    """A logarithmic axis with a plain number at every octave."""
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


def _cells(camera: Camera, columns: int) -> tuple[int, int]:
    """How many columns and rows of about square cells."""
    return columns, max(1, round(columns * camera.height_px / camera.width_px))


def _cell_of(pixels_px: Array, camera: Camera, shape: tuple[int, int]) -> NDArray[np.intp]:
    """(n,) number of each pixel's cell, row by row."""
    size, most = np.array([camera.width_px, camera.height_px]), np.array(shape) - 1
    at = np.floor((pixels_px + 0.5) / size * shape).astype(np.intp)
    column, row = np.clip(at, 0, most).T
    return np.asarray(row * shape[0] + column)


def _counts(pixels_px: Array, camera: Camera, shape: tuple[int, int]) -> NDArray[np.intp]:
    """(rows, columns) how many pixels each cell has."""
    number = _cell_of(pixels_px, camera, shape)
    counts = np.bincount(number, minlength=shape[0] * shape[1])
    return np.asarray(counts.reshape(shape[1], shape[0]))


def _cell_means(camera: Camera, errors: Errors) -> tuple[Array, Array, float]:
    """(m, 2) centres, (m, 2) mean residuals of the cells that have enough; the cells' width."""
    shape = _cells(camera, _ARROW_CELLS)
    number = _cell_of(errors.pixels_px, camera, shape)
    counts = _counts(errors.pixels_px, camera, shape).ravel()
    sums = [np.bincount(number, weights=v, minlength=len(counts)) for v in errors.vectors_px.T]
    full = np.flatnonzero(counts >= _LEAST_IN_CELL)
    means = np.column_stack(sums)[full] / counts[full, None]
    size = np.array([camera.width_px, camera.height_px])
    places = np.column_stack([full % shape[0], full // shape[0]])
    return (places + 0.5) / shape * size - 0.5, means, camera.width_px / shape[0]


def _arrow_factor(means: Array, cell_px: float) -> float:
    """A round number by which the longer arrows fill their cells."""
    longest = float(np.quantile(np.hypot(*means.T), 0.9)) if len(means) else 0.0
    wanted = max(1.0, 0.9 * cell_px / max(longest, 1e-6))
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * _NICE[wanted / power >= _NICE].max())

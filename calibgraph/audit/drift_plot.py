"""The picture of a comparison: the deviations of all results, per camera and axis."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibgraph.audit.drift_result import CameraDrift, Drift
from calibgraph.report.figure import new_picture, save_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_ROW_IN, _FRAME_IN, _RESULT_IN = 2.2, 1.2, 0.55
_NARROWEST_IN, _WIDEST_IN = 9.0, 30.0
_COLUMNS = (
    ("rotation [deg]", slice(0, 3), 180 / np.pi, ("pitch x", "yaw y", "roll z")),
    ("translation [cm]", slice(3, 6), 100.0, ("x right", "y down", "z ahead")),
)
# Colours that differ for the colour-blind too (Okabe and Ito, "Color universal design").
_AXIS_COLOURS = ("#0072B2", "#E69F00", "#009E73")
_CHANGED = "#D55E00"
_TURNED_DEG = 30.0  # names below the panels
_APART = 0.16  # of two axes of one result, in results


def draw_drift(drift: Drift, path: Path) -> None:
    """Draw the deviations with their sigmas and the tolerance; PNG, atomically.

    Raises:
        FileError: if it cannot be written there.
    """
    save_picture(drift_figure(drift), path, {"Software": "calibgraph drift"})


def drift_figure(drift: Drift) -> Figure:
    """A row per camera: rotations and translations of its results."""
    rows = len(drift.cameras)
    width_in = float(np.clip(2 * _RESULT_IN * len(drift.results), _NARROWEST_IN, _WIDEST_IN))
    figure = new_picture(width_in, _FRAME_IN + _ROW_IN * rows)
    grid = figure.subplots(rows, 2, sharex=True, squeeze=False)
    tolerances = (drift.tolerance_deg, drift.tolerance_cm)
    for row, (name, entries) in enumerate(drift.cameras.items()):
        for axes, column, tolerance in zip(grid[row], _COLUMNS, tolerances, strict=True):
            _draw_panel(axes, entries, column, tolerance)
        grid[row, 0].set_title(name, loc="left", fontsize=10)
    for axes in grid[-1]:
        axes.set_xticks(range(len(drift.results)), drift.results, rotation=_TURNED_DEG, ha="right")
    for axes in grid[0]:
        axes.legend(fontsize=8, ncols=4, loc="lower right", bbox_to_anchor=(1, 1), frameon=False)
    figure.suptitle(
        f"Which result deviates from the others? {drift.status}\n"
        "deviation from the other results, 1 sigma; grey: the tolerance; circled: CHANGED",
        fontsize=10,
    )
    return figure


def _draw_panel(
    axes: Axes,
    entries: tuple[CameraDrift, ...],
    column: tuple[str, slice, float, tuple[str, ...]],
    tolerance: float,
) -> None:
    """Three axes of one camera in all results."""
    label, part, scale, names = column
    axes.axhspan(-tolerance, tolerance, color="0.93", zorder=0)
    axes.axhline(0, color="0.6", linewidth=0.8, zorder=1)
    seen = [place for place, each in enumerate(entries) if each.deviation is not None]
    deviations = np.array([entries[k].deviation for k in seen]).reshape(-1, 6)[:, part] * scale
    sigmas = np.array([entries[k].sigma for k in seen]).reshape(-1, 6)[:, part] * scale
    for k, (name, colour) in enumerate(zip(names, _AXIS_COLOURS, strict=True)):
        x = np.array(seen) + _APART * (k - 1)
        changed = [part.start + k in entries[place].axes for place in seen]
        axes.errorbar(x, deviations[:, k], sigmas[:, k], fmt="o", markersize=4, color=colour,
                      label=name, linewidth=1.2)  # fmt: skip
        axes.scatter(x[changed], deviations[changed, k], s=110, facecolors="none",
                     edgecolors=_CHANGED, linewidths=1.5, zorder=3)  # fmt: skip
    for place in sorted({*range(len(entries))} - {*seen}):
        axes.text(place, 0, "?", ha="center", va="center", color="0.4")
    axes.set_ylabel(label, fontsize=9)
    axes.set_xlim(-0.6, len(entries) - 0.4)
    axes.tick_params(labelsize=8)

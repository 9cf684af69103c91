"""The experiment's report as Markdown, JSON and a plot."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.paper.experiment import (
    IMPROVEMENT,
    REPROJECTION,
    ROTATION,
    TRANSLATION,
    Block,
    Interval,
    Report,
    Row,
)
from benchmarks.paper.methods import HEADLINE
from benchmarks.paper.published import AXES, PAIR, published
from benchmarks.tables import Table
from calibgraph.report.as_json import finite

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_HEADS = {
    TRANSLATION: "E_t [cm]", ROTATION: "E_R [deg]", "x_cm": "x [cm]", "y_cm": "y [cm]",
    "z_cm": "z [cm]", "roll_deg": "roll [deg]", "pitch_deg": "pitch [deg]",
    "yaw_deg": "yaw [deg]", REPROJECTION: "reproj. [px]", IMPROVEMENT: "better than Stage 1 [px]",
}  # fmt: skip
_NOTES = """\
Medians over the draws in which the method found extrinsics, in brackets the 5 % and 95 % quantiles.
Errors without signs. *paper*: the number that the paper publishes for this row and N, from one run
on its own data, which is not this data. All rows have the same correspondences and the same guess.

* Rows "paper (TRF)": the paper's objective, hyper-parameters and solver (SciPy), from its Stage 1.
  By Eq. 5 the priors alone have their minimum at Stage 1, so "priors only" repeats it; the paper's
  own numbers for that row differ.
* "per-camera BA": each camera alone, reprojection term only, the paper's scales, our solver.
* "relative pose known": the relative pose of neighbouring cameras is given, within 1 mrad and 2 mm
  per axis.
* "oracle weights": every frame of a camera is weighted by its inverse mean square error, computed
  from the simulation's truth: an approximate bound of what weights can achieve. It is not strict
  where an error is common to all frames: frames whose own errors compensate for it get too much
  weight.
"""
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
_MIN_SHOWN = 1e-4  # deg or cm: zero on a logarithmic axis
_COLUMN_IN, _ROW_IN, _NAMES_IN = 3.3, 0.27, 2.6


def write_report(report: Report, folder: Path) -> list[Path]:
    """Write ``paper.md``, ``paper.json`` and ``paper.png``; returns their paths."""
    written = [folder / f"paper.{kind}" for kind in ("md", "json", "png")]
    folder.mkdir(parents=True, exist_ok=True)
    written[0].write_text(markdown(report), "utf-8")
    content = finite(json.loads(json.dumps(to_mapping(report))))
    written[1].write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", "utf-8")
    _plot(report, written[2])
    return written


def worst_cameras(block: Block) -> Table:
    """The errors of the worst camera of every row: the median and the 95 % quantile."""
    heads = ("worst camera", "E_R [deg]", "95 %", "E_t [cm]", "95 %", "failed")
    rows = (
        (name, *_worst(row, ROTATION, 3), *_worst(row, TRANSLATION, 2), str(row.failed or ""))
        for name, row in block.rows.items()
    )
    title = f"{block.frames} frames, {block.draws} draws, against {block.reference}"
    return Table(title, heads, tuple(rows))


def _worst(row: Row, metric: str, digits: int) -> list[str]:
    """Median and 95 % quantile of the camera with the largest median error."""
    found = [metrics[metric] for name, metrics in row.numbers.items() if "->" not in name]
    if not found:
        return ["-", "-"]
    worst = max(found, key=lambda interval: interval.median)
    return [f"{worst.median:.{digits}f}", f"{worst.high:.{digits}f}"]


def to_mapping(report: Report) -> dict[str, Any]:
    """As plain values; times in their own key, so that the rest only depends on the seed."""
    content = asdict(report)
    content["seconds"] = [
        {"frames": b.frames, **{row: r.seconds for row, r in b.rows.items()}} for b in report.blocks
    ]
    for block in content["blocks"]:
        for row in block["rows"].values():
            del row["seconds"]
    return content


def markdown(report: Report) -> str:
    """The paper's two tables: errors per camera; between cameras and of reprojection."""
    parts = [f"# {report.data}", _heading(report), _NOTES]
    for block in report.blocks:
        parts.append(f"## N = {block.frames}, against: {block.reference} ({block.draws} draws)")
        for index, camera in enumerate(_cameras(block)):
            parts.append(f"### {camera}")
            parts.append("\n".join(_camera_table(report, block, camera, index)))
        parts.append("### Between cameras, and reprojection")
        parts.append("\n".join(_consistency_table(report, block)))
    return "\n\n".join(parts) + "\n"


def _heading(report: Report) -> str:
    return f"Settings of the paper's rows: preset {report.preset}. Seed {report.seed}."


def _camera_table(report: Report, block: Block, camera: str, index: int) -> Iterator[str]:
    heads = ["method", *(_HEADS[m] for m in AXES), "paper E_t", "paper E_R", "failed", "s"]
    yield from _head(heads)
    for name, row in block.rows.items():
        theirs = published(report.published_as, name, block.frames, index)
        yield _line([
            _name(name),
            *(_cell(row, camera, m) for m in AXES),
            *(_number(theirs.get(m)) for m in (TRANSLATION, ROTATION)),
            f"{row.failed} of {block.draws}" if row.failed else "",
            f"{row.seconds:.2f}",
        ])  # fmt: skip


def _consistency_table(report: Report, block: Block) -> Iterator[str]:
    cameras, pairs = _cameras(block), _pairs(block)
    columns = [(pair, m) for pair in pairs for m in (ROTATION, TRANSLATION)]
    columns += [(camera, m) for camera in cameras for m in (REPROJECTION, IMPROVEMENT)]
    heads = [f"{name}: {_HEADS[m]}" for name, m in columns]
    theirs: list[tuple[int | str, str]] = [(PAIR, ROTATION), (PAIR, TRANSLATION)] * bool(pairs)
    theirs += [(index, REPROJECTION) for index in range(min(2, len(cameras)))]
    paper = [f"paper {'between' if c == PAIR else cameras[int(c)]} {_HEADS[m]}" for c, m in theirs]
    yield from _head(["method", *heads, *paper])
    for name, row in block.rows.items():
        values = [published(report.published_as, name, block.frames, c).get(m) for c, m in theirs]
        cells = (_cell(row, camera, m) for camera, m in columns)
        yield _line([_name(name), *cells, *(_number(value) for value in values)])


def _head(heads: Sequence[str]) -> Iterator[str]:
    yield _line(heads)
    yield "|" + "---|" * len(heads)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _name(row: str) -> str:
    return f"**{row}**" if row == HEADLINE else row


def _cell(row: Row, name: str, metric: str) -> str:
    if name not in row.numbers:
        return "failed"
    values = row.numbers[name].get(metric)
    if values is None or np.isnan(values.median):
        return "-"
    return f"{_number(values.median)} ({_number(values.low)} to {_number(values.high)})"


def _number(value: float | None) -> str:
    """Three digits, as the paper writes numbers; empty for None."""
    if value is None:
        return ""
    digits = 3 if abs(value) < 1 else 2 if abs(value) < 10 else 1  # noqa: PLR2004 - digits
    return f"{round(value, digits) + 0.0:.{digits}f}"  # no negative zero


def _cameras(block: Block) -> list[str]:
    return [name for name in _names(block) if "->" not in name]


def _pairs(block: Block) -> list[str]:
    return [name for name in _names(block) if "->" in name]


def _names(block: Block) -> list[str]:
    """Cameras and pairs, from the first row that did not always fail."""
    return next((list(row.numbers) for row in block.rows.values() if row.numbers), [])


def _plot(report: Report, path: Path) -> None:
    """E_t and E_R per camera, a line per method, a colour per N; against the first reference."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    first = report.blocks[0].reference
    blocks = [block for block in report.blocks if block.reference == first]
    cameras, rows = _cameras(blocks[0]), list(blocks[0].rows)
    columns = max(1, len(cameras))
    width, height = _NAMES_IN + _COLUMN_IN * columns, 2 * (_ROW_IN * len(rows) + 0.8)
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, columns, squeeze=False, sharey=True)
    for column, camera in enumerate(cameras):
        for line, metric in enumerate((TRANSLATION, ROTATION)):
            _draw_panel(grid[line, column], blocks, (camera, metric), rows)
        grid[0, column].set_title(camera, fontsize=10)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(blocks), frameon=False)
    figure.savefig(path, format="png")


def _draw_panel(
    axes: Axes, blocks: Sequence[Block], what: tuple[str, str], rows: Sequence[str]
) -> None:
    """One panel: medians with their intervals."""
    camera, metric = what
    for index, block in enumerate(blocks):
        shift = 0.16 * (index - (len(blocks) - 1) / 2)
        places: list[tuple[float, Interval]] = [
            (line + shift, row.numbers[camera][metric])
            for line, row in enumerate(block.rows.values())
            if camera in row.numbers
        ]
        middle = np.array([max(i.median, _MIN_SHOWN) for _, i in places])
        ends = np.array([[max(i.low, _MIN_SHOWN), max(i.high, _MIN_SHOWN)] for _, i in places])
        spread = np.abs(ends.reshape(-1, 2).T - middle)
        axes.errorbar(
            middle, [place for place, _ in places], xerr=spread, fmt="o", markersize=4, capsize=2,
            color=_COLOURS[index % len(_COLOURS)], label=f"N = {block.frames}",
        )  # fmt: skip
    axes.set_xlabel(f"{_HEADS[metric]}, median and 90 % of the draws")
    _set_scales(axes, rows)


def _set_scales(axes: Axes, rows: Sequence[str]) -> None:
    """Plain numbers on the logarithmic x axis, the names of the methods on the other."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(axis="x", labelsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.grid(color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)

"""The experiment's report in Markdown, beside the numbers that the paper publishes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from benchmarks.paper.draws import HEADLINE, STAGE1, TRF_TERMS
from benchmarks.paper.experiment import REPROJECTION, Report, Row

ROTATION, TRANSLATION = "rotation_error_deg", "translation_error_cm"
AXES = (TRANSLATION, ROTATION, "x_cm", "y_cm", "z_cm", "roll_deg", "pitch_deg", "yaw_deg")
_HEADS = {
    TRANSLATION: "E_t [cm]", ROTATION: "E_R [deg]", "x_cm": "x [cm]", "y_cm": "y [cm]",
    "z_cm": "z [cm]", "roll_deg": "roll [deg]", "pitch_deg": "pitch [deg]",
    "yaw_deg": "yaw [deg]", REPROJECTION: "reproj. [px]",
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
"""
_REPROJECTION, _PRIORS, _FULL = TRF_TERMS
PUBLISHED: dict[tuple[str, str, int], tuple[tuple[float, ...], ...]] = {
    ("kitti", STAGE1, 10): ((1.14, 0.002), (5.99, 0.001), (5.04, 0.001), (1.09, 0.52)),
    ("kitti", _REPROJECTION, 10): ((), (), (4.37, 0.035), (0.72, 0.43)),
    ("kitti", _PRIORS, 10): ((), (), (4.18, 0.178), (2.19, 0.56)),
    ("kitti", _FULL, 10): ((1.19, 0.043), (5.17, 0.030), (4.11, 0.033), (0.67, 0.41)),
    ("kitti", STAGE1, 100): ((2.63, 0.187), (6.23, 0.137), (3.56, 0.206), (2.57, 0.65)),
    ("kitti", _REPROJECTION, 100): ((), (), (4.46, 0.040), (0.77, 0.54)),
    ("kitti", _PRIORS, 100): ((), (), (4.18, 0.178), (2.19, 0.56)),
    ("kitti", _FULL, 100): ((0.89, 0.038), (4.97, 0.030), (4.16, 0.037), (0.71, 0.50)),
    ("walkley", STAGE1, 10): ((150.9, 0.91), (41.6, 0.63), (117.1, 1.08), ()),
    ("walkley", _REPROJECTION, 10): ((60.2, 1.06), (24.3, 0.50), (47.8, 1.06), ()),
    ("walkley", _PRIORS, 10): ((133.7, 0.80), (35.5, 0.56), (100.9, 1.06), ()),
    ("walkley", _FULL, 10): ((54.2, 0.95), (21.9, 0.45), (43.1, 0.95), ()),
    ("walkley", STAGE1, 100): ((87.2, 1.09), (108.6, 1.66), (87.0, 1.06), ()),
    ("walkley", _REPROJECTION, 100): ((25.7, 0.825), (3.57, 0.230), (23.9, 0.914), ()),
    ("walkley", _PRIORS, 100): ((75.6, 0.9), (93.2, 1.5), (76.5, 0.9), ()),
    ("walkley", _FULL, 100): ((22.6, 0.726), (3.14, 0.203), (21.0, 0.804), ()),
}
"""The paper's tables 2 to 4, single runs without intervals, per data, row and N: E_t [cm] and E_R
[deg] of both cameras and between them, and the reprojection errors of both [px]."""
PAIR = 2


def published(data: str, row: str, frames: int, which: int) -> dict[str, float]:
    """The paper's numbers by metric of the first or second camera or PAIR; empty without any."""
    known = PUBLISHED.get((data, row, frames), ())
    if which >= len(known) or which > PAIR:
        return {}
    found = dict(zip((TRANSLATION, ROTATION), known[which], strict=False))
    return found | ({REPROJECTION: known[3][which]} if which < PAIR and known[3] else {})


def markdown(published_as: str, draws: int, report: Report) -> Iterator[str]:
    """The paper's two tables: errors per camera; between cameras and of reprojection.

    Args:
        published_as: the paper's data set to compare with, or nothing.
        draws: of each number of frames.
        report: its rows.
    """
    yield _NOTES
    for frames, rows in report.items():
        yield f"## N = {frames} ({draws} draws)"
        names = next((list(row.numbers) for row in rows.values() if row.numbers), [])
        cameras, pairs = ([n for n in names if ("->" in n) == pair] for pair in (False, True))
        table = partial(_table, rows, draws, partial(published, published_as, frames=frames))
        for index, camera in enumerate(cameras):
            theirs = [(index, m) for m in (TRANSLATION, ROTATION)]
            yield f"### {camera}\n\n" + "\n".join(table([(camera, m) for m in AXES], theirs))
        columns = [(pair, m) for pair in pairs for m in (ROTATION, TRANSLATION)]
        columns += [(camera, REPROJECTION) for camera in cameras]
        theirs = [(PAIR, ROTATION), (PAIR, TRANSLATION), (0, REPROJECTION), (1, REPROJECTION)]
        yield "### Between cameras, and reprojection\n\n" + "\n".join(table(columns, theirs))


def _table(
    rows: Mapping[str, Row], draws: int, paper: Callable[..., dict[str, float]],
    ours: Sequence[tuple[str, str]], theirs: Sequence[tuple[int, str]],
) -> Iterator[str]:  # fmt: skip
    where = ("first", "second", "between")
    heads = ["method", *(f"{name}: {_HEADS[m]}" for name, m in ours),
             *(f"paper {where[c] if c < len(where) else ''} {_HEADS[m]}" for c, m in theirs),
             "failed", "s"]  # fmt: skip
    yield f"| {' | '.join(heads)} |\n|" + "---|" * len(heads)
    for name, row in rows.items():
        known = (paper(row=name, which=c).get(m) for c, m in theirs)
        failed = f"{row.failed} of {draws}" if row.failed else ""
        cells = [f"**{name}**" if name == HEADLINE else name, *(_cell(row, *at) for at in ours),
                 *("" if v is None else _number(v) for v in known), failed,
                 f"{row.seconds:.2f}"]  # fmt: skip
        yield f"| {' | '.join(cells)} |"


def _cell(row: Row, name: str, metric: str) -> str:
    if name not in row.numbers:
        return "failed"
    low, median, high = row.numbers[name].get(metric, (np.nan,) * 3)
    if np.isnan(median):
        return "-"
    return f"{_number(median)} ({_number(low)} to {_number(high)})"


def _number(value: float) -> str:
    """Three digits, as the paper writes numbers."""
    digits = 3 if abs(value) < 1 else 2 if abs(value) < 10 else 1
    return f"{round(value, digits) + 0.0:.{digits}f}"  # no negative zero

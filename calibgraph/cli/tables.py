"""Results as tables for a terminal, in degrees and centimetres."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calibgraph.arrays import Array
from calibgraph.cli.terminal import print_plain
from calibgraph.model.calibration import FRAMES_SENTENCE, Calibration
from calibgraph.model.geometry import degrees_and_centimetres
from calibgraph.model.metrics import Evaluation, PoseError, pose_error
from calibgraph.model.places import describe_places
from calibgraph.model.summary import Summary

if TYPE_CHECKING:
    from calibgraph.matching.cmrnext.training.validation import Validation

_DETAILS = "report.html or calibration.yaml"
CAMERA_AXES_COLUMNS = (
    "pitch x\ndeg", "yaw y\ndeg", "roll z\ndeg", "x right\ncm", "y down\ncm", "z ahead\ncm",
)  # fmt: skip
_COLOURS = {"PASS": "green", "WARN": "yellow", "FAIL": "red"}


def print_result(console: Console, result: Calibration, written: list[Path]) -> None:
    """Print the verdict with its reasons, a line per camera, and the files that were written."""
    print_summary(console, result.summary)
    console.print(result_table(result))
    config = result.config
    console.print(
        "off: probability of an error over "
        f"{config.tolerance_deg:g} deg or {config.tolerance_cm:g} cm, - where data for it are "
        "missing; moved: from the guess; median: error of all matches, in pixels; inliers, "
        "matches: within the gate"
    )
    if result.places:
        print_plain(console, describe_places(result.places))
    console.print(error_bar_table(result))
    console.print(
        f"one standard deviation of the {config.of}: scatter between frames, and the error that "
        f"the matcher reports as common to its frames; {result.not_included}"
        f"{result.verdict.images_note}; A->B: of the transform from A to B, in B's axes"
    )
    if result.unstated_lenses:
        print_plain(console, result.unstated_lenses)
    if result.lens:
        console.print(lens_table(result))
    time = f"{sum(result.timings_s.values()):.1f} s; " if result.timings_s else ""
    console.print(f"{time}{FRAMES_SENTENCE}; written:", highlight=False)
    for path in written:
        print_plain(console, f"  {path}")


def print_summary(console: Console, summary: Summary) -> None:
    """Print the verdict, at most three reasons, what to do, and how much is folded."""
    status = summary.status
    probability = f": {summary.error_probability}" if summary.error_probability else ""
    console.print(
        f"[bold {_COLOURS[status]}]{status}[/]{escape(probability)}",
        highlight=False,
        soft_wrap=True,
    )
    for reason in summary.reasons:
        print_plain(console, f"  {reason.status}  {', '.join(reason.cameras)}: {reason.text}")
    if summary.actions:
        print_plain(console, "What to do:")
    for action in summary.actions:
        print_plain(console, f"  {action}")
    if summary.error_bar:
        print_plain(console, summary.error_bar)
    if summary.others:
        print_plain(console, f"{len(summary.others)} more findings: see {_DETAILS}")


def print_weights(console: Console, summary: Mapping[str, Any], converted: Path | None) -> None:
    """Print the content of a file of weights."""
    network = ", ".join(f"{key} {value}" for key, value in summary["network"].items())
    config = ", ".join(f"{key} {value}" for key, value in summary["config"].items())
    print_plain(console, f"{summary['file']}: CMRNext, {summary['parameters']} parameters")
    for line in (f"sha256 {summary['sha256']}", f"network: {network}", f"config: {config}"):
        print_plain(console, f"  {line}")
    if converted is not None:
        print_plain(console, f"{converted}: written")


def print_validation(console: Console, validation: Validation) -> None:
    """Print the errors of a network in training, on held-out frames."""
    v = validation
    print_plain(
        console,
        f"step {v.step}: loss {v.train_loss:.4g}; held out: flow error {v.epe_px:.2f} px (median "
        f"{v.median_px:.2f}) of {v.zero_px:.2f}; pose of a frame {v.pose_deg:.3f} deg "
        f"{v.pose_cm:.1f} cm of {v.start_deg:.3f} deg {v.start_cm:.1f} cm (medians; "
        f"{v.failed_share:.0%} failed)",
    )


def result_table(result: Calibration) -> Table:
    """One row per camera: verdict, change from the guess, residuals and matches."""
    table = empty_table("Calibration", "camera", "verdict")
    numbers = ("moved\ndeg", "moved\ncm", "median\npx", "inliers", "matches", "frames", "prior")
    add_number_columns(table, "off", *numbers)
    for name, T in result.T_camera_lidar.items():
        moved = pose_error(T, result.initial_rig.T_camera_lidar[name])
        residuals = result.residuals.get(name)
        verdict = result.camera_verdicts[name]
        table.add_row(
            escape(name),
            f"[{_COLOURS[verdict.status]}]{verdict.status}[/]",
            verdict.percent,
            f"{moved.rotation_error_deg:.2f}",
            f"{moved.translation_error_cm:.1f}",
            "-" if residuals is None else f"{residuals.median_px:.2f}",
            "-" if residuals is None else f"{residuals.inlier_share:.0%}",
            str(result.counts[name]["used"]),
            str(result.counts[name]["frames_used"]),
            "-" if name not in result.prior_share else f"{result.prior_share[name]:.0%}",
        )
    return table


def error_bar_table(result: Calibration) -> Table:
    """One row per camera and per pair of cameras: a standard deviation per axis."""
    table = empty_table("Error bar, along the axes of the camera", "camera")
    add_number_columns(table, *CAMERA_AXES_COLUMNS)
    for name in (*result.covariance, *result.pair_covariance):
        table.add_row(escape(name), *_error_bar_cells(result, name))
    for name, covariance in result.bootstrap.items():
        if result.error_bar_holds(name):
            sigmas = degrees_and_centimetres(covariance)
            table.add_row(escape(f"{name} (bootstrap)"), *_sigma_cells(*sigmas))
    return table


def lens_table(result: Calibration) -> Table:
    """One row per parameter of each lens and clock that was estimated."""
    table = empty_table("Lens and clock", "camera", "parameter")
    add_number_columns(table, "estimate", "sigma", "prior", "prior\nsigma")
    table.add_column("with the pose")
    for name, parameters in result.lens.items():
        for one in parameters:
            label = f"{one.name} {one.printed_unit}".strip()
            table.add_row(escape(name), label, *one.printed, one.describe())
    return table


def _error_bar_cells(result: Calibration, name: str) -> list[str]:
    """Six numbers, or why there are none."""
    sigmas = result.error_bar(name)
    if sigmas is not None:
        return _sigma_cells(*sigmas)
    why = "not determined" if result.error_bar_holds(name) else "unknown: FAIL"
    return [*why.split(), *[""] * 6][:6]


def _sigma_cells(rotation_deg: Array, translation_cm: Array) -> list[str]:
    return [f"{v:.3f}" for v in rotation_deg] + [f"{v:.2f}" for v in translation_cm]


def empty_table(title: str, *names: str) -> Table:
    """An empty table, narrow enough not to cut numbers on 80 columns."""
    table = Table(title=title, box=SIMPLE, padding=0)
    for name in names:
        table.add_column(name, no_wrap=True)
    return table


def add_number_columns(table: Table, *headings: str) -> None:
    """Add columns whose cells are aligned to the right."""
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)


def _lens_words(pixels: float) -> str:
    """How far a lens is from the reference's."""
    if math.isnan(pixels):
        return "the images differ in size from the reference, so lenses are not compared"
    if math.isinf(pixels):
        return "this lens or the reference's does not see all corners of the image"
    return f"lens up to {pixels:.1f} px from the reference in the corners of the image"


def print_evaluation(console: Console, errors: Evaluation, estimate: Path, reference: Path) -> None:
    """Print the errors, and the two files that were compared."""
    console.print(evaluation_table(errors))
    if errors.deviations:
        console.print(deviation_table(errors))
    for name, pixels in errors.lens_px.items():
        print_plain(console, f"{name}: {_lens_words(pixels)}")
    for what, of in (("time offset", errors.time_offset_ms), ("read-out", errors.readout_ms)):
        for name, value in of.items():
            print_plain(console, f"{name}: {what} {value:+.1f} ms from the reference")
    for what, path in (("estimate", estimate), ("reference", reference)):
        print_plain(console, f"{what}: {path}")
    if errors.deviations:
        print_plain(
            console, "of: whose error bars count; p: how likely so large a difference is by chance"
        )
    if errors.pairs:
        print_plain(console, "A->B: of the transform from A to B, in the axes of B")


def evaluation_table(errors: Evaluation) -> Table:
    """One row per camera and per pair of cameras."""
    table = empty_table("Estimate - reference, in the axes of the camera", "camera")
    add_number_columns(
        table,
        "E_R\ndeg", "E_t\ncm", "x\ncm", "y\ncm", "z\ncm",
        "roll\ndeg", "pitch\ndeg", "yaw\ndeg",
    )  # fmt: skip
    for name, error in errors.cameras.items():
        table.add_row(escape(name), *_cells(error))
    if errors.pairs:
        table.add_section()
    for name, error in errors.pairs.items():
        table.add_row(escape(name), *_cells(error))
    return table


def deviation_table(errors: Evaluation) -> Table:
    """One row per camera whose reference has error bars."""
    table = empty_table("The same in standard deviations", "camera")
    add_number_columns(
        table, "pitch x", "yaw y", "roll z", "x right", "y down", "z ahead", "p of\nall six", "of"
    )
    for name, found in errors.deviations.items():
        cells = [f"{value:+.1f}" for value in (*found.rotation, *found.translation)]
        table.add_row(escape(name), *cells, f"{found.p:.2g}", found.of)
    return table


def _cells(error: PoseError) -> list[str]:
    return [
        f"{error.rotation_error_deg:.3f}",
        f"{error.translation_error_cm:.2f}",
        *(f"{value:.2f}" for value in (error.x_cm, error.y_cm, error.z_cm)),
        *(f"{value:.3f}" for value in (error.roll_deg, error.pitch_deg, error.yaw_deg)),
    ]

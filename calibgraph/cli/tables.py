"""Results as tables for a terminal, in degrees and centimetres."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calibgraph.arrays import Array
from calibgraph.cli.terminal import elapsed_s, print_plain
from calibgraph.model.calibration import FRAMES_SENTENCE, Calibration
from calibgraph.model.geometry import degrees_and_centimetres
from calibgraph.model.metrics import Evaluation, PoseError, pose_error
from calibgraph.model.places import describe_places
from calibgraph.model.result_files import CALIBRATION_FILE
from calibgraph.model.summary import Summary
from calibgraph.model.threshold import fixed

CAMERA_AXES_COLUMNS = (
    "pitch x\ndeg", "yaw y\ndeg", "roll z\ndeg", "x right\ncm", "y down\ncm", "z ahead\ncm",
)  # fmt: skip
_COLOURS = {"PASS": "green", "WARN": "yellow", "FAIL": "red"}


def print_result(console: Console, result: Calibration, written: list[Path]) -> None:
    """Print the verdict with its reasons, a line per camera, and the files that were written."""
    details = next((path.name for path in written if path.suffix == ".html"), CALIBRATION_FILE)
    print_summary(console, result.summary, details)
    console.print(result_table(result))
    config = result.config
    console.print(
        f"off: probability of an error above {config.tolerance_deg:g} deg or "
        f"{config.tolerance_cm:g} cm, - if data for it are missing. moved: change from the guess. "
        "median: residual of all matches. inliers, matches: within the gate."
    )
    if result.places:
        print_plain(console, describe_places(result.places))
    console.print(error_bar_table(result))
    unknown = any(not result.error_bar_holds(name) for name in result.covariance)
    console.print(
        f"1 sigma per axis of the {config.of}. Not included: {result.not_included}."
        f"{result.verdict.images_note} A->B is the relative pose, in B's axes."
        + " A FAIL has no error bar."
        * unknown
    )
    if result.unstated_lenses:
        print_plain(console, result.unstated_lenses)
    if result.lens:
        console.print(lens_table(result))
    print_plain(console, f"{elapsed_s():.1f} s; {FRAMES_SENTENCE}; written:")
    for path in written:
        print_plain(console, f"  {path}")


def print_summary(console: Console, summary: Summary, details: str) -> None:
    """Print the verdict, its reasons, what to do, and how much is in the file of the details."""
    status = summary.status
    probability = f": {summary.error_probability}" if summary.error_probability else ""
    console.print(
        f"[bold {_COLOURS[status]}]{status}[/]{escape(probability)}",
        highlight=False,
        soft_wrap=True,
    )
    lines = [f"  {each.status}  {', '.join(each.cameras)}: {each.text}" for each in summary.reasons]
    if summary.actions:
        lines += ["What to do:", *(f"  {action}" for action in summary.actions)]
    lines += summary.moves
    lines += filter(None, [summary.error_bar])
    if more := len(summary.others):
        lines.append(f"{more} more finding{'s' if more > 1 else ''}: see {details}")
    for line in lines:
        print_plain(console, line)


def print_weights(console: Console, summary: Mapping[str, Any], converted: Path | None) -> None:
    """Print the content of a file of weights."""
    network = ", ".join(f"{key} {value}" for key, value in summary["network"].items())
    config = ", ".join(f"{key} {value}" for key, value in summary["config"].items())
    print_plain(console, f"{summary['file']}: CMRNext, {summary['parameters']} parameters")
    for line in (f"sha256 {summary['sha256']}", f"network: {network}", f"config: {config}"):
        print_plain(console, f"  {line}")
    if converted is not None:
        print_plain(console, f"{converted}: written")


def result_table(result: Calibration) -> Table:
    """One row per camera: verdict, change from the guess, residuals and matches."""
    table = empty_table("Calibration", "camera", words=("verdict",))
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
            fixed(moved.rotation_error_deg, 2),
            fixed(moved.translation_error_cm, 1),
            "-" if residuals is None else fixed(residuals.median_px, 2),
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
    """Six numbers; a dash each if there are none, or they do not hold."""
    sigmas = result.error_bar(name)
    return ["-"] * 6 if sigmas is None else _sigma_cells(*sigmas)


def _sigma_cells(rotation_deg: Array, translation_cm: Array) -> list[str]:
    return [fixed(v, 3) for v in rotation_deg] + [fixed(v, 2) for v in translation_cm]


def empty_table(title: str, *names: str, words: tuple[str, ...] = ()) -> Table:
    """An empty table: on 80 columns its names fold, and words and numbers are never cut."""
    table = Table(title=title, box=SIMPLE, padding=0)
    for name in names:
        table.add_column(name, overflow="fold")
    for word in words:
        table.add_column(word, no_wrap=True)
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
        cells = [fixed(value, 1, "+") for value in (*found.rotation, *found.translation)]
        table.add_row(escape(name), *cells, f"{found.p:.2g}", found.of)
    return table


def _cells(error: PoseError) -> list[str]:
    return [
        fixed(error.rotation_error_deg, 3),
        fixed(error.translation_error_cm, 2),
        *(fixed(value, 2) for value in (error.x_cm, error.y_cm, error.z_cm)),
        *(fixed(value, 3) for value in (error.roll_deg, error.pitch_deg, error.yaw_deg)),
    ]

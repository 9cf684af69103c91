"""Results as tables for a terminal, in degrees and centimetres."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import gtsam
import numpy as np
from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calibgraph.arrays import Array
from calibgraph.model.calibration import FRAMES_SENTENCE, Calibration
from calibgraph.model.metrics import Evaluation, PoseError, pose_error
from calibgraph.model.places import describe_places
from calibgraph.model.result_files import CALIBRATION_FILE
from calibgraph.model.summary import Summary
from calibgraph.model.verdict import fixed

CAMERA_AXES = (
    "pitch x\ndeg", "yaw y\ndeg", "roll z\ndeg", "x right\ncm", "y down\ncm", "z ahead\ncm",
)  # fmt: skip
LIDAR_AXES = ("roll x\ndeg", "pitch y\ndeg", "yaw z\ndeg", "x\ncm", "y\ncm", "z\ncm")
_COLOURS = {"PASS": "green", "WARN": "yellow", "FAIL": "red"}


def make_table(
    title: str,
    rows: Iterable[Iterable[str]],
    *,
    names: tuple[str, ...] = ("camera",),
    words: tuple[str, ...] = (),
    numbers: Iterable[str] = CAMERA_AXES,
) -> Table:
    """A table: on 80 columns its names fold, and words and numbers are never cut.

    Args:
        title: above it.
        rows: cells; the first one is escaped.
        names: headings of the first columns.
        words: of those behind, not folded.
        numbers: of the last ones, aligned to the right.
    """
    table = Table(title=title, box=SIMPLE, padding=0)
    for name in names:
        table.add_column(name, overflow="fold")
    for word in words:
        table.add_column(word, no_wrap=True)
    for number in numbers:
        table.add_column(number, justify="right", no_wrap=True)
    for first, *cells in rows:
        table.add_row(escape(first), *cells)
    return table


def print_result(
    console: Console, result: Calibration, written: list[Path], elapsed_s: float
) -> None:
    """Print the verdict with its reasons, a line per camera, and the files that were written."""
    details = next((path.name for path in written if path.suffix == ".html"), CALIBRATION_FILE)
    print_summary(console, result.summary, details)
    if result.rig.cameras:
        _print_cameras(console, result)
    if result.lidar_verdicts:
        console.print(lidar_table(result))
        console.print(
            f"moved: change from the guess. 1 sigma about and along the axes of {result.rig.lidar}."
        )
    if result.vehicle_sigmas is not None:
        console.print(vehicle_table(result))
    frames = FRAMES_SENTENCE if result.rig.cameras else "p_base = T_base_lidar * p_lidar"
    console.out(f"{elapsed_s:.1f} s; {frames}; written:", highlight=False)
    for path in written:
        console.out(f"  {path}", highlight=False)


def _print_cameras(console: Console, result: Calibration) -> None:
    console.print(result_table(result))
    config = result.config
    console.print(
        f"off: probability of an error above {config.tolerance_deg:g} deg or "
        f"{config.tolerance_cm:g} cm, - if data for it are missing. moved: change from the guess. "
        "median: residual of all matches. inliers, matches: within the gate."
    )
    if result.places:
        console.out(describe_places(result.places), highlight=False)
    console.print(error_bar_table(result))
    unknown = any(not result.error_bar_holds(name) for name in result.covariance)
    console.print(
        f"1 sigma per axis of the {config.of}. Not included: {result.not_included}."
        f"{result.verdict.images_note} A->B is the relative pose, in B's axes."
        + " A FAIL has no error bar."
        * unknown
    )
    if result.unstated_lenses:
        console.out(result.unstated_lenses, highlight=False)
    if result.lens:
        console.print(lens_table(result))


def print_summary(console: Console, summary: Summary, details: str) -> None:
    """Print the verdict, its reasons, what to do, and how much is in the file of the details."""
    status = f"[bold {_COLOURS[summary.status]}]{summary.status}[/]"
    probability = f": {summary.error_probability}" if summary.error_probability else ""
    console.print(f"{status}{escape(probability)}", highlight=False, soft_wrap=True)
    lines = [f"  {each.status}  {', '.join(each.cameras)}: {each.text}" for each in summary.reasons]
    if summary.actions:
        lines += ["What to do:", *(f"  {action}" for action in summary.actions)]
    lines += [*summary.moves, *filter(None, [summary.error_bar])]
    if more := len(summary.others):
        lines.append(f"{more} more finding{'s' if more > 1 else ''}: see {details}")
    for line in lines:
        console.out(line, highlight=False)


def result_table(result: Calibration) -> Table:
    """One row per camera: verdict, change from the guess, residuals and matches."""
    rows, guess = [], result.initial_rig.T_camera_lidar
    for name, T in result.T_camera_lidar.items():
        residuals, counts = result.residuals.get(name), result.counts[name]
        rows.append([
            *_judged(result, name),
            *moved_cells(T, guess[name]),
            "-" if residuals is None else fixed(residuals.median_px, 2),
            "-" if residuals is None else f"{residuals.inlier_share:.0%}",
            str(counts["used"]),
            str(counts["frames_used"]),
        ])  # fmt: skip
    numbers = ("off", "moved\ndeg", "moved\ncm", "median\npx", "inliers", "matches", "frames")
    return make_table("Calibration", rows, words=("verdict",), numbers=numbers)


def lidar_table(result: Calibration) -> Table:
    """One row per LiDAR but the base: verdict, change from the guess, a sigma per axis."""
    guess, T = result.initial_rig.T_base_lidar, result.T_base_lidar
    rows = [
        [*_judged(result, name), *moved_cells(T[name], guess.get(name)), *_error_bar(result, name)]
        for name in result.lidar_verdicts
    ]
    numbers = ("off", "moved\ndeg", "moved\ncm", *LIDAR_AXES)
    return make_table(
        f"LiDARs in {result.rig.lidar}", rows, names=("LiDAR",), words=("verdict",), numbers=numbers
    )


def _judged(result: Calibration, name: str) -> list[str]:
    """A sensor, its verdict, and the probability that it is off."""
    verdict = result.verdicts[name]
    return [name, f"[{_COLOURS[verdict.status]}]{verdict.status}[/]", verdict.percent]


def moved_cells(T: Array, guess: Array | None) -> list[str]:
    """The change of a pose from its guess in degrees and centimetres; dashes without one."""
    if guess is None:
        return ["-", "-"]
    moved = pose_error(T, guess)
    return [fixed(moved.rotation_error_deg, 2), fixed(moved.translation_error_cm, 1)]


def vehicle_table(result: Calibration) -> Table:
    """Roll, pitch, yaw and the position of the base LiDAR on the vehicle, with their sigmas."""
    assert result.rig.vehicle is not None
    T, sigmas = result.rig.vehicle.T_vehicle_lidar, result.rig.vehicle.sigmas
    scale = np.repeat([180.0 / np.pi, 100.0], 3)
    values = np.zeros(6) if T is None else np.concatenate([gtsam.Rot3(T[:3, :3]).rpy(), T[:3, 3]])
    known = np.isfinite(sigmas)
    rows = [
        ["value", *(fixed(v, 2) if k else "-" for v, k in zip(values * scale, known, strict=True))],
        ["sigma", *(fixed(v, 3) if k else "-" for v, k in zip(sigmas * scale, known, strict=True))],
    ]
    title = f"{result.rig.lidar} in {result.rig.vehicle.frame}"
    return make_table(title, rows, names=("",), numbers=LIDAR_AXES)


def error_bar_table(result: Calibration) -> Table:
    """One row per camera and per pair of cameras: a standard deviation per axis."""
    names = (*result.covariance, *result.pair_covariance)
    rows = [[name, *_error_bar(result, name)] for name in names]
    return make_table("Error bar, along the axes of the camera", rows)


def _error_bar(result: Calibration, name: str) -> list[str]:
    """A standard deviation per axis in degrees and centimetres; dashes without them."""
    if (sigmas := result.error_bar(name)) is None:
        return ["-"] * 6
    return [fixed(v, 3) for v in sigmas[0]] + [fixed(v, 2) for v in sigmas[1]]


def lens_table(result: Calibration) -> Table:
    """One row per parameter of each lens and clock that was estimated."""
    numbers = ("estimate", "sigma", "prior", "prior\nsigma")
    table = make_table("Lens and clock", (), names=("camera", "parameter"), numbers=numbers)
    table.add_column("with the pose")
    for name, parameters in result.lens.items():
        for one in parameters:
            label = f"{one.name} {one.printed_unit}".strip()
            table.add_row(escape(name), label, *one.printed, one.describe())
    return table


def print_evaluation(console: Console, errors: Evaluation, estimate: Path, reference: Path) -> None:
    """Print the errors, and the two files that were compared."""
    console.print(evaluation_table(errors))
    if errors.deviations:
        console.print(deviation_table(errors))
    lines = [f"{name}: {_lens_words(pixels)}" for name, pixels in errors.lens_px.items()]
    for what, of in (("time offset", errors.time_offset_ms), ("read-out", errors.readout_ms)):
        lines += [f"{name}: {what} {ms:+.1f} ms from the reference" for name, ms in of.items()]
    lines += [f"estimate: {estimate}", f"reference: {reference}"]
    if errors.deviations:
        lines.append("of: whose error bars count; p: chance of so large a difference")
    if errors.pairs:
        lines.append("A->B: of the transform from A to B, in the axes of B")
    for line in lines:
        console.out(line, highlight=False)


def _lens_words(pixels: float) -> str:
    """How far a lens is from the reference's."""
    if math.isnan(pixels):
        return "the images differ in size from the reference, so lenses are not compared"
    if math.isinf(pixels):
        return "this lens or the reference's does not see all corners of the image"
    return f"lens up to {pixels:.1f} px from the reference in the corners of the image"


def evaluation_table(errors: Evaluation) -> Table:
    """One row per camera and per pair of cameras."""
    numbers = (
        "E_R\ndeg", "E_t\ncm", "x\ncm", "y\ncm", "z\ncm", "roll\ndeg", "pitch\ndeg", "yaw\ndeg"
    )  # fmt: skip
    rows = [[name, *_cells(error)] for of in (errors.cameras, errors.pairs)
            for name, error in of.items()]  # fmt: skip
    title = "Estimate - reference, in the axes of the camera"
    table = make_table(title, rows, numbers=numbers)
    table.rows[len(errors.cameras) - 1].end_section = bool(errors.pairs)
    return table


def _cells(error: PoseError) -> list[str]:
    return [
        fixed(error.rotation_error_deg, 3),
        fixed(error.translation_error_cm, 2),
        *(fixed(value, 2) for value in (error.x_cm, error.y_cm, error.z_cm)),
        *(fixed(value, 3) for value in (error.roll_deg, error.pitch_deg, error.yaw_deg)),
    ]


def deviation_table(errors: Evaluation) -> Table:
    """One row per camera whose reference has error bars."""
    rows = [
        [name, *(fixed(value, 1, "+") for value in (*found.rotation, *found.translation)),
         f"{found.p:.2g}", found.of]
        for name, found in errors.deviations.items()
    ]  # fmt: skip
    axes = ("pitch x", "yaw y", "roll z", "x right", "y down", "z ahead", "p of\nall six", "of")
    return make_table("The same in standard deviations", rows, numbers=axes)

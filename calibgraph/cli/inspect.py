"""The commands report, evaluate, check, drift, perturb, doctor, export and simulate."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from shlex import join
from typing import TYPE_CHECKING

import typer
from typer import Argument, Option

import calibgraph
from calibgraph.cli import options
from calibgraph.cli.options import bag_settings, checked_arguments, dataset_from, matcher_from
from calibgraph.cli.terminal import elapsed_s, print_line, progress_bar, terminal
from calibgraph.io.formats import EXPORT_FORMATS
from calibgraph.stdout import print_json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def report(
    result: Path = Argument(..., metavar="RESULT", help="Its folder, or its calibration.yaml."),
    out: Path | None = Option(
        None, metavar="FILE.html", help="Page. (default: report.html beside the result)"
    ),
    force: options.Force = False,
) -> None:
    """Show a result as one HTML page that opens without a network."""
    from calibgraph.files import require_new_file
    from calibgraph.model.result_files import REPORT_FILE
    from calibgraph.report.html import write_report

    if out is not None:
        require_new_file(out, ".html", ".htm", force=force)
    loaded, folder = (
        calibgraph.load_calibration(result),
        result if result.is_dir() else result.parent,
    )
    path = write_report(loaded, out or folder / REPORT_FILE)
    print_line(f"{path}: written; the verdict is {loaded.verdict.status}")


def evaluate(
    estimate: Path = Argument(..., metavar="ESTIMATE", help="Rig to evaluate."),
    reference: Path = Argument(..., metavar="REFERENCE", help="Rig to compare with."),
    as_json: options.JsonOption = False,
) -> None:
    """Compare an estimate with a reference: the paper's metrics, per camera and per pair.

    Of a reference with error bars, as `calibgraph pick` writes it, in standard deviations as well.
    """
    from calibgraph.io.calibrations import stated_result
    from calibgraph.io.rigs import rig_file

    path = rig_file(estimate)
    stated = stated_result(path)
    bars = None if stated is None else stated.error_bars
    errors = calibgraph.evaluate(
        calibgraph.load_rig(estimate), calibgraph.load_rig(reference), bars
    )
    if as_json:
        print_json(asdict(errors))
    else:
        from calibgraph.report.tables import print_evaluation

        print_evaluation(terminal(), errors, path, rig_file(reference))


_EXIT_CODES = {"OK": 0, "WRONG": 1, "CHANGED": 1, "CANNOT TELL": 3}


def check(
    *,
    rig: Path = Argument(..., metavar="RIG", help="The deployed calibration: a result or a rig."),
    dataset: options.Datasets,
    tolerance_deg: options.ToleranceDeg = 0.5,
    tolerance_cm: options.ToleranceCm = 10.0,
    frames: options.Frames = None,
    topic: options.Topic = None,
    motion: options.Motion = None,
    config: options.ReadingFile = None,
    seed: options.Seed = 0,
    out: Path | None = Option(None, metavar="FILE.html", help="The answer as a page."),
    as_json: options.JsonOption = False,
    force: options.Force = False,
) -> None:
    """Is a deployed calibration still right? Exit 0: all OK, 1: WRONG, 3: the data cannot tell.

    Compares it with images and clouds of a recent recording, per camera, LiDAR and axis. Writes no
    file but the page, if one is wanted.
    """
    from calibgraph.audit.judgement import tolerance_twist
    from calibgraph.files import require_new_file

    if out is not None:
        require_new_file(out, ".html", ".htm", force=force)
    with checked_arguments():
        tolerance_twist(tolerance_deg, tolerance_cm)
        matcher = matcher_from("structure", seed=seed, all_frames=frames is not None)
    data = dataset_from(dataset, rig, frames, bag_settings(config, topic, motion=motion))
    with progress_bar() as progress:
        audit = calibgraph.check(
            rig, data, tolerance_deg=tolerance_deg, tolerance_cm=tolerance_cm,
            matcher=matcher, seed=seed, progress=progress,
        )  # fmt: skip
    if out is not None:
        calibgraph.write_audit_report(audit, out)
    if as_json:
        from calibgraph.audit import audit_summary

        print_json(audit_summary(audit))
    else:
        from calibgraph.audit.page import print_audit

        print_audit(terminal(), audit, out, elapsed_s())
    raise typer.Exit(_EXIT_CODES[audit.status])


def drift(
    results: list[Path] = Argument(
        ..., metavar="RESULT...", help="Of one rig: their folders, or calibration.yaml files."
    ),
    tolerance_deg: options.ToleranceDeg = 0.5,
    tolerance_cm: options.ToleranceCm = 10.0,
    own_lenses: bool = Option(
        False, "--own-lenses", help="Lenses may differ: several vehicles, each with its own."
    ),
    as_json: options.JsonOption = False,
) -> None:
    """Which of several results of one rig deviates? Exit 0: none, 1: one CHANGED, 3: cannot tell.

    Compares each result with the others that agree, per camera, LiDAR and axis, without a
    reference: of several days, or of several vehicles. One false alarm in 100 calls.
    """
    with checked_arguments():
        sizes = {"tolerance_deg": tolerance_deg, "tolerance_cm": tolerance_cm}
        found = calibgraph.drift(results, **sizes, own_lenses=own_lenses)
    if as_json:
        from calibgraph.audit import drift_summary

        print_json(drift_summary(found))
    else:
        from calibgraph.audit.page import print_drift

        print_drift(terminal(), found)
        print_line("nothing was written")
    raise typer.Exit(_EXIT_CODES[found.status])


def perturb(
    rig: Path = Argument(..., metavar="RIG", help="Rig to displace, usually a reference."),
    out: Path = Option(..., metavar="FILE.yaml", help="Rig file to write: the displaced guess."),
    rotation_deg: float = Option(20.0, min=0, help="Angle, about a random axis."),
    translation_m: float = Option(1.5, min=0, help="Length, in a random direction."),
    seed: options.Seed = 0,
    uniform: bool = Option(False, "--uniform", help="Per axis, uniform within +- the values."),
    force: options.Force = False,
) -> None:
    """Displace every camera at random, T_delta * T_camera_lidar: the paper's initial guesses."""
    from calibgraph.files import require_new_file

    require_new_file(out, ".yaml", ".yml", force=force)
    given = calibgraph.load_rig(rig)
    with checked_arguments():
        size = {"rotation_deg": rotation_deg, "translation_m": translation_m}
        displaced = calibgraph.perturb(given, **size, seed=seed, uniform=uniform)
    displaced.save(out)
    print_line(f"{out}: {len(displaced.cameras)} cameras displaced (seed {seed})")


def doctor(
    dataset: options.Datasets,
    rig: options.RigFile = None,
    frames: options.Frames = None,
    every_s: options.EveryS = None,
    topic: options.Topic = None,
    motion: options.Motion = None,
    config: options.ReadingFile = None,
    out: Path | None = Option(
        None, metavar="DIR", help="For guess_CAMERA.png, images with the guess, and doctor.json."
    ),
    as_json: options.JsonOption = False,
) -> None:
    """Examine a dataset before it is calibrated: what is there, what to fix; exit 1 if anything."""
    from calibgraph.files import require_own_folder, write_text

    if out is not None:
        require_own_folder(out, dataset)
    with checked_arguments(), progress_bar("reading"):
        bag = bag_settings(config, topic, every_s=every_s, motion=motion)
        guess = calibgraph.load_rig(rig) if rig else None
        found = calibgraph.diagnose(dataset, guess, frames=frames, bag=bag, pictures=out)
    if out is not None:
        write_text(out / "doctor.json", json.dumps(found.to_mapping(), indent=1))
    if as_json:
        print_json(found.to_mapping())
    else:
        lines = [f"{finding.level:8} {finding.text}" for finding in found.findings]
        lines += [f"{path}: written" for path in found.pictures]
        if all(finding.level == "note" for finding in found.findings):
            given = {"--rig": rig, "--frames": frames, "--every-s": every_s, "--motion": motion,
                     "--config": config}  # fmt: skip
            pairs = [pair for pair in given.items() if pair[1] is not None]
            pairs += [("--topic", each) for each in topic or ()]
            words = [*dataset, *(word for pair in pairs for word in pair)]
            lines.append(f"no faults; next: calibgraph calibrate {join(map(str, words))}")
        print_line(*lines)
    if not found.healthy:
        raise typer.Exit(1)


_FORMATS = "; ".join(f"{name}: {meaning}" for name, meaning in EXPORT_FORMATS.items()) + "."


def export(
    source: Path = Argument(
        ..., metavar="RESULT|RIG", help="Result (its folder or file), or a rig."
    ),
    format: str = Option(
        ...,
        metavar="FORMAT",
        help=_FORMATS,
    ),
    out: Path = Option(..., metavar="FILE", help="File to write; of camera_info a folder."),
    camera: list[str] | None = Option(
        None, metavar="NAME", help="Only this camera; may be repeated. (default: all)"
    ),
    lidar_frame: str | None = Option(
        None, metavar="FRAME", help="Frame id of the LiDAR. (default: its name in the rig)"
    ),
    camera_frame: str | None = Option(
        None,
        metavar="TEXT",
        help="Frame id of optical frames; {camera} is the name. (default: that of the bag, or "
        "{camera}_optical_frame)",
    ),
    lidar_pose: str | None = Option(
        None,
        metavar='"X Y Z ROLL PITCH YAW"',
        help="Of autoware: the LiDAR in sensor_kit_base_link, metres and radians. (default: at 0)",
    ),
    deployed: Path | None = Option(
        None,
        metavar="FILE",
        help="Of autoware: the sensor_kit_calibration.yaml in use. Only calibrated rows change, "
        "which is printed.",
    ),
    even_if_failed: bool = Option(False, "--even-if-failed", help="Also with the verdict FAIL."),
    force: options.Force = False,
) -> None:
    """Write a calibration in the format of another program, with its direction as a comment."""
    import numpy as np

    from calibgraph.io.formats.export import describe_changes, read_kit
    from calibgraph.model.plausibility import MAX_DISTANCE_M, find_implausible

    with checked_arguments(), progress_bar("writing"):
        T_base_lidar = None if lidar_pose is None else _parse_pose(lidar_pose)
        before = {} if deployed is None else read_kit(deployed)
        written = calibgraph.export_calibration(
            source, out, format, cameras=camera or None, lidar_frame=lidar_frame,
            camera_frame=camera_frame, T_base_lidar=T_base_lidar, deployed=deployed,
            even_if_failed=even_if_failed, force=force,
        )  # fmt: skip
        rig = calibgraph.load_rig(source)
    rig = rig.model_copy(
        update={"cameras": {name: rig.cameras[name] for name in camera or rig.cameras}}
    )
    if T_base_lidar is not None and np.linalg.norm(T_base_lidar[:3, 3]) > MAX_DISTANCE_M:
        print_line(f"warning: --lidar-pose {lidar_pose!r}: lengths in millimetres?")
    lines = [f"warning: {line}" for line in find_implausible(rig)]
    lines += describe_changes(before, read_kit(out)) if before else []
    print_line(*lines, *(f"{path}: written ({format})" for path in written))


def _parse_pose(text: str) -> NDArray[np.float64]:
    """The (4, 4) of six numbers."""
    from calibgraph.io.rig_parts import pose_of_angles

    try:
        x, y, z, roll, pitch, yaw = (float(word) for word in text.replace(",", " ").split())
    except ValueError as error:
        raise ValueError(
            f"--lidar-pose {text!r}: give six numbers, X Y Z ROLL PITCH YAW"
        ) from error
    try:
        return pose_of_angles((x, y, z), (roll, pitch, yaw))
    except ValueError as error:
        raise ValueError(f"--lidar-pose {text!r}: {error}") from error


STREET = "street"


def simulate(
    scenario: str = Argument(
        ...,
        metavar="SCENARIO",
        help="street: a dataset of scans and images of a drive along a procedural street.",
    ),
    out: Path = Option(..., metavar="DIR", help="Folder to write."),
    frames: int = Option(10, help="Number of frames."),
    rotation_deg: float = Option(5.0, min=0, help="Rotation error of the guess, rig.yaml."),
    translation_m: float = Option(0.3, min=0, help="Translation error of the guess."),
    seed: options.Seed = 0,
    rig: str = Option(
        "kitti",
        metavar="NAME|RIG",
        help="kitti, walkley (stereo pairs), surround (six cameras), fisheye (four), omni "
        "(two that see more than a half-space), sample (three small ones), or a rig file; its "
        "extrinsics are the truth.",
    ),
    beams: int = Option(64, metavar="16|32|64|128", help="Of the LiDAR."),
    step_m: float = Option(4.0, help="Mean distance between frames."),
) -> None:
    """Simulate data with a known truth, reference.yaml, and a displaced guess, rig.yaml."""
    from calibgraph.simulation.rigs import RIG_NAMES, rig_of

    with progress_bar() as progress, checked_arguments():
        if scenario != STREET:
            raise ValueError(f"unknown scenario {scenario!r}; known is {STREET}")
        is_file = rig not in RIG_NAMES and rig and Path(rig).exists()
        written = calibgraph.simulate_street(
            out, calibgraph.load_rig(rig) if is_file else rig_of(rig), beams=beams, frames=frames,
            step_m=step_m, seed=seed, rotation_deg=rotation_deg, translation_m=translation_m,
            progress=progress,
        )  # fmt: skip
    print_line(*(f"{path}: written" for path in written))

"""The commands about what is there: report, evaluate, perturb, doctor, weights."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from shlex import join

import typer
from typer import Argument, Option

from calibgraph.cli import options
from calibgraph.cli.arguments import bag_settings, checked_arguments
from calibgraph.cli.terminal import print_json, print_line, progress_bar, terminal

_PAGES = (".html", ".htm")


def report(
    result: Path = Argument(..., metavar="RESULT", help="Its folder, or its calibration.yaml."),
    out: Path | None = Option(
        None, metavar="FILE.html", help="Page. (default: report.html beside, or none for viewers)"
    ),
    rerun: Path | None = Option(None, metavar="FILE.rrd", help="Recording for Rerun."),
    mcap: Path | None = Option(None, metavar="FILE.mcap", help="Recording for Foxglove."),
    dataset: list[Path] | None = Option(
        None, metavar="DATASET", help="Where images and clouds are now; repeat it in their order."
    ),
    force: options.Force = False,
) -> None:
    """Show a result: as one HTML page that opens without a network, or for viewers.

    Viewers show clouds, images and projected points, before and after.
    """
    from calibgraph.files import require_new_file
    from calibgraph.io.calibrations import load_calibration
    from calibgraph.io.dataset import load_dataset
    from calibgraph.model.result_files import REPORT_FILE
    from calibgraph.report.frames import relocate_frames
    from calibgraph.report.html import write_report

    for path, suffixes in ((out, _PAGES), (rerun, (".rrd",)), (mcap, (".mcap",))):
        if path is not None:
            require_new_file(path, *suffixes, force=force)
    loaded, written = load_calibration(result), []
    if dataset:
        with checked_arguments():
            loaded = relocate_frames(loaded, load_dataset(dataset, loaded.rig))
    if out is not None or (rerun is None and mcap is None):
        folder = result if result.is_dir() else result.parent
        written.append(write_report(loaded, out or folder / REPORT_FILE))
    os.environ.setdefault("RUST_LOG", "off")  # Rerun logs what our line states
    with progress_bar("reading") as progress:
        if rerun is not None:
            from calibgraph.view.rerun_file import write_rerun

            written.append(write_rerun(loaded, rerun, progress=progress))
        if mcap is not None:
            from calibgraph.view.mcap_file import write_mcap

            written.append(write_mcap(loaded, mcap, progress=progress))
    for path in written:
        print_line(f"{path}: written; the verdict is {loaded.verdict.status}")


def evaluate(
    estimate: Path = Argument(..., metavar="ESTIMATE", help="Rig to evaluate."),
    reference: Path = Argument(..., metavar="REFERENCE", help="Rig to compare with."),
    as_json: options.JsonOption = False,
) -> None:
    """Compare an estimate with a reference: the paper's metrics, per camera and per pair.

    Of a reference with error bars, as `calibgraph pick` writes it, in standard deviations as well.
    """
    from calibgraph.io.calibrations import error_bars
    from calibgraph.io.rigs import load_rig, rig_file
    from calibgraph.model.metrics import evaluate

    path = rig_file(estimate)
    errors = evaluate(load_rig(estimate), load_rig(reference), error_bars(path))
    if as_json:
        print_json(asdict(errors))
    else:
        from calibgraph.report.tables import print_evaluation

        print_evaluation(terminal(), errors, path, rig_file(reference))


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
    from calibgraph.io.rigs import load_rig
    from calibgraph.model.metrics import perturb

    require_new_file(out, ".yaml", ".yml", force=force)
    given = load_rig(rig)
    with checked_arguments():
        size = {"rotation_deg": rotation_deg, "translation_m": translation_m}
        displaced = perturb(given, **size, seed=seed, uniform=uniform)
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
    from calibgraph.doctor import diagnose
    from calibgraph.file_sets import require_own_folder
    from calibgraph.files import write_text
    from calibgraph.io.rigs import load_rig

    if out is not None:
        require_own_folder(out, dataset)
    with checked_arguments(), progress_bar("reading"):
        bag = bag_settings(config, topic, every_s=every_s, motion=motion)
        guess = load_rig(rig) if rig else None
        found = diagnose(dataset, guess, frames=frames, bag=bag, pictures=out)
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
        for line in lines:
            print_line(line)
    if not found.healthy:
        raise typer.Exit(1)


def weights(
    file: Path = Argument(..., metavar="FILE", help="Weights, .tar or .safetensors."),
    out: Path | None = Option(None, metavar="FILE", help="Convert to this .safetensors file."),
    as_json: options.JsonOption = False,
    force: options.Force = False,
) -> None:
    """Check a file of CMRNext weights, print what is in it, and convert it to safetensors."""
    from calibgraph.files import require_new_file

    if out is not None:
        require_new_file(out, ".safetensors", force=force)
    from calibgraph.matching.cmrnext import load_checkpoint

    checkpoint = load_checkpoint(file)
    if out is not None:
        checkpoint.save_safetensors(out)
    if as_json:
        print_json(checkpoint.summary())
    else:
        from calibgraph.report.tables import print_weights

        print_weights(terminal(), checkpoint.summary(), out)

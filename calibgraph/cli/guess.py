"""The commands for a rig to begin with: guess, from words, files or nothing; init; bag."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli import outputs
from calibgraph.cli.arguments import bag_options_from, checked_arguments
from calibgraph.cli.exchange import RigFilesOptions, parse_names, print_doubts
from calibgraph.cli.options import JsonOption, SeedOption, TopicOption
from calibgraph.cli.terminal import print_json, print_plain, progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.model.rig import Rig


def guess(
    files: RigFilesOptions,
    out: Annotated[Path, typer.Option(), outputs.rig_of("guess")],
    mount: list[str] | None = None,
    dataset: list[Path] | None = None,
    search: list[str] | None = None,
    forward: str = "+x",
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Write a rig to begin a calibration with, by words, a URDF or a search, and how good it is.

    Args:
        out (FILE.yaml): Rig file to write.
        dataset (DATASET): Images and clouds: cameras without words or an extrinsic in a file are
            searched for over all headings. Slower, and less sure. May be repeated.
        search (NAME): Search for this camera although a file has an extrinsic.
    """
    from calibgraph.guessing.guess import guess_rig
    from calibgraph.model.lens_knowledge import state_calibrated
    from calibgraph.outputs import yaml_mark

    with checked_arguments(), progress_bar("reading") as progress:
        parts = files.read()
        found = guess_rig(
            parts,
            mountings=parse_names("--mount", mount),
            data=dataset or None,
            search=search or (),
            forward=forward,
            size_px=files.size_px,
            seed=seed,
            progress=progress,
        )
    found = replace(found, rig=state_calibrated(found.rig))
    found.save(out, first_line=yaml_mark("guess"))
    if as_json:
        print_json(found.to_mapping())
    print_doubts(found.rig, parts.notes)
    for line in found.lines:
        print_plain(terminal(), line)
    print_plain(terminal(), f"{out}: written; check the sentences above against the vehicle")


def init(
    dataset: Path,
    out: Path | None = None,
    mount: list[str] | None = None,
    lens: list[str] | None = None,
    forward: str = "+x",
    force: bool = False,
) -> None:
    """Write a rig.yaml to fill in: the cameras and image sizes of a folder, each key explained.

    Args:
        dataset (DATASET): Folder with lidar/ and cameras/NAME/.
        out (FILE.yaml): Rig file to write. (default: DATASET/rig.yaml)
        lens ([NAME=]HOW): How the lens of a camera, or of all, is known: calibration; a horizontal
            field of view, as '90 deg'; or focal length and size of a pixel, as '4 mm 3 um'. May be
            repeated. (default: asked in a terminal, else calibration)
        force: Replace the file, and the values in it.
    """
    from calibgraph.guessing.lens_words import CALIBRATION
    from calibgraph.guessing.template import cameras_of_folder, write_rig_template
    from calibgraph.io.dataset_folders import describe_pairing

    with checked_arguments():
        words = parse_names("--mount", mount)
        known = _lenses(lens, [*cameras_of_folder(dataset)])
        path = write_rig_template(
            dataset, out, mountings=words, lenses=known, forward=forward, replace=force
        )
        pairing = describe_pairing(dataset)
    if pairing:
        print_plain(terminal(), pairing)
    left = "FILL_IN" in path.read_text(encoding="utf-8").partition("\nformat:")[2]
    where = f"{dataset}" if out is None else f"{dataset} --rig {out}"
    first = "replace every FILL_IN; then" if left else "next"
    print_plain(terminal(), f"{path}: written; {first}: calibgraph doctor {where}")
    if any(how != CALIBRATION for how in known.values()):
        print_plain(
            terminal(),
            "a lens from a spec sheet or a field of view is known to 2 %, so estimate it: "
            f"calibgraph calibrate {where} --estimate lens",
        )


def _lenses(given: list[str] | None, cameras: list[str]) -> dict[str, str]:
    """How the lens of each camera is known, as given for all or one, or asked for."""
    from calibgraph.guessing.lens_words import CALIBRATION, LENS_GRAMMAR

    for_all = [how for how in given or () if "=" not in how]
    if not given and _is_terminal():
        answers = [CALIBRATION]
        for name in cameras:
            question = f"{name}: how is its lens known? {LENS_GRAMMAR}"
            answers.append(typer.prompt(question, default=answers[-1], err=True))
        return dict(zip(cameras, answers[1:], strict=True))
    named = parse_names("--lens", [how for how in given or () if "=" in how])
    return dict.fromkeys(cameras, for_all[-1] if for_all else CALIBRATION) | named


def _is_terminal() -> bool:
    return sys.stdin.isatty() and sys.stderr.isatty()


def bag(
    path: Path,
    out: Annotated[Path | None, outputs.rig_of("bag")] = None,
    topic: TopicOption = None,
    tie_deg: Annotated[float | None, typer.Option(min=0.001)] = None,
    tie_m: Annotated[float | None, typer.Option(min=1e-5)] = None,
    correct: list[str] | None = None,
    as_json: JsonOption = False,
) -> None:
    """List the topics of a ROS bag, and write its rig: camera_info and /tf_static.

    Args:
        path (BAG): ROS 1 bag, or ROS 2 bag: its folder or file.
        out (FILE.yaml): Rig file to write: the lenses and the guess.
        tie_deg (DEG): Take the cameras' relative poses in /tf_static as measured, with this sigma
            per axis; with --tie-m. (default: they are only a guess)
        tie_m (M): The sigma in translation, per axis.
    """
    from calibgraph.io.bags.rig import doubtful_axes, read_bag_rig
    from calibgraph.io.formats.describe import describe_rig
    from calibgraph.model.lens_knowledge import state_calibrated
    from calibgraph.model.plausibility import find_implausible
    from calibgraph.outputs import yaml_mark
    from calibgraph.trust.conventions import correct_guess

    with checked_arguments():
        sigmas = _sigmas(tie_deg, tie_m)
        options = bag_options_from(topic)
    topics = _topics(path)
    if not as_json:
        for name, kind, count in topics:
            print_plain(terminal(), f"{name}  {kind}  {count}")
    read = read_bag_rig(path, options)
    rig = state_calibrated(correct_guess(read.to_rig(sigmas), correct or ()))
    if out is not None:
        rig.save(out, first_line=yaml_mark("bag"))
    notes = [*doubtful_axes(rig), *read.notes]
    notes += [f"warning: {line}" for line in find_implausible(rig)]
    if as_json:
        _print_json(topics, rig, notes, out)
        return
    for line in (*describe_rig(rig), *notes):
        print_plain(terminal(), line)
    if out is not None:
        print_plain(terminal(), f"{out}: written")


def _sigmas(tie_deg: float | None, tie_m: float | None) -> tuple[float, float] | None:
    """The sigmas of relative poses, [rad] and [m]."""
    from math import radians

    if tie_deg is None and tie_m is None:
        return None
    if tie_deg is None or tie_m is None:
        raise ValueError("--tie-deg and --tie-m: give both")
    return radians(tie_deg), tie_m


def _topics(path: Path) -> list[tuple[str, str, int]]:
    """Name, type and number of messages of each topic."""
    from calibgraph.errors import FileError
    from calibgraph.io.bags.messages import Bag
    from calibgraph.io.bags.storage import is_bag

    if not is_bag(path):
        raise FileError(path, "is no ROS bag; expected a .bag, .mcap or .db3 file, or the folder "
                        "of a ROS 2 bag with its metadata.yaml")  # fmt: skip
    topics = sorted(Bag(path).topics.values(), key=lambda each: each.name)
    return [(each.name, each.type, each.count) for each in topics]


def _print_json(
    topics: list[tuple[str, str, int]], rig: Rig, notes: list[str], out: Path | None
) -> None:
    keys = ("topic", "type", "messages")
    print_json(
        {
            "topics": [dict(zip(keys, each, strict=True)) for each in topics],
            "rig": rig.model_dump(mode="json"),
            "notes": notes,
            "out": None if out is None else str(out),
        }
    )

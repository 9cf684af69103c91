"""The command for a rig to begin with: from a bag, a folder, words, or files of others."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from shlex import join
from typing import Any

from typer import Argument, Option

import calibgraph
from calibgraph.cli import options
from calibgraph.cli.options import bag_settings, checked_arguments, parse_names
from calibgraph.cli.terminal import print_line, progress_bar
from calibgraph.errors import CalibrationError
from calibgraph.io.formats import IMPORT_FORMATS
from calibgraph.stdout import print_json

_TAKEN = {
    "a folder of images and clouds": {"mount", "lens"},
    "bags alone": {"topic", "correct", "json"},
    "files": {"mount", "rename", "lidar_frame", "camera_frame", "size", "correct", "json"},
}
"""The options that change something, by the kind of source."""


def rig(
    source: list[str] = Argument(
        ...,
        metavar="SOURCE...",
        help="A ROS bag; a folder with lidar/ and cameras/NAME/; or files: "
        f"{IMPORT_FORMATS}. NAME=FILE names the camera of a file of one camera.",
    ),
    out: Path | None = Option(
        None, metavar="FILE.yaml", help="Rig to write. (default: in a folder rig.yaml, else none)"
    ),
    mount: list[str] | None = Option(
        None,
        metavar="NAME=WORDS",
        help="How a camera is mounted: front, front-left, left, rear-left, rear, ...; then "
        "NUMBER deg left|right|up|down|clockwise|counterclockwise from there, upside down, "
        "NUMBER m|cm ahead|behind|left|right|above|below of the LiDAR. May be repeated.",
    ),
    lens: list[str] | None = Option(
        None,
        metavar="[NAME=]HOW",
        help="Of a folder: how the lens of a camera, or of all, is known: calibration; a "
        "horizontal field of view, as '90 deg'; or focal length and size of a pixel, as "
        "'4 mm 3 um'. May be repeated. (default: calibration)",
    ),
    forward: str = Option("+x", metavar="+x|-x|+y|-y", help="The LiDAR's axis ahead; z is up."),
    topic: options.Topic = None,
    rename: list[str] | None = Option(
        None, metavar="OLD=NEW", help="Another name of a camera; may be repeated."
    ),
    lidar_frame: str | None = Option(
        None, metavar="FRAME", help="The LiDAR's frame. (default: the one named so)"
    ),
    camera_frame: list[str] | None = Option(
        None,
        metavar="NAME=FRAME",
        help="Frame of a camera, where the names differ; may be repeated. A frame with "
        "'optical' in its name is x right, y down, z forward, others are x forward, z up.",
    ),
    size: str | None = Option(None, metavar="WIDTHxHEIGHT", help="Image size, if files have none."),
    correct: list[str] | None = Option(
        None,
        metavar="[CAMERA=]MISTAKE",
        help="Undo a mistake of the guess, by the name that doctor gives it, as inverse or "
        "camera-flu; of all cameras or of one. May be repeated.",
    ),
    as_json: options.JsonOption = False,
    force: options.Force = False,
) -> None:
    """Write a rig to begin a calibration with, and print where each camera looks and sits.

    Of a ROS bag: its topics, lenses and /tf_static. Of a folder: its cameras, and each key that is
    left to fill in explained. Of files of other programs: what they hold together, and how good a
    guess it is if cameras are described.
    """
    from calibgraph.files import require_new_file
    from calibgraph.io.bags.storage import is_bag
    from calibgraph.model.lens import state_calibrated
    from calibgraph.model.plausibility import find_implausible
    from calibgraph.trust.conventions import correct_guess

    given = {
        "mount": mount, "lens": lens, "topic": topic, "rename": rename, "lidar_frame": lidar_frame,
        "camera_frame": camera_frame, "size": size, "correct": correct, "json": as_json or None,
    }  # fmt: skip
    kind = "bags alone" if not mount and all(map(is_bag, source)) else "files"
    if len(source) == 1 and not correct and _is_to_fill_in(Path(source[0])):
        kind = "a folder of images and clouds"
    for name in (name for name, value in given.items() if value is not None):
        if name not in _TAKEN[kind]:
            kinds = " or ".join(each for each, names in _TAKEN.items() if name in names)
            raise CalibrationError(f"--{name.replace('_', '-')} is for {kinds} only; leave it out")
    if kind not in ("bags alone", "files"):
        _write_template(Path(source[0]), out, mount, lens, forward=forward, replace=force)
        return
    if out is not None:
        require_new_file(out, ".yaml", ".yml", force=force)
    with checked_arguments(), progress_bar("reading"):
        if kind == "bags alone":
            made, notes, topics = _rig_of_bags([*map(Path, source)], topic)
            guess = None
        else:
            topics = list[dict[str, Any]]()
            made, notes, guess = _rig_of_files(
                source, mount, forward=forward, size_px=_size_px(size), lidar_frame=lidar_frame,
                rename=parse_names("--rename", rename),
                camera_frames=parse_names("--camera-frame", camera_frame),
            )  # fmt: skip
        made = state_calibrated(correct_guess(made, correct or ()))
        guess = guess and replace(guess, rig=made)
    if out is not None:
        (guess or made).save(out)
    notes += [f"warning: {line}" for line in find_implausible(made)]
    if as_json:
        found = {"topics": topics, "rig": made.model_dump(mode="json"), "notes": notes}
        written = {"out": None if out is None else str(out)}
        print_json(found | written | (guess.to_mapping() if guess else {}))
        return
    lines = [f"{each['topic']}  {each['type']}  {each['messages']}" for each in topics]
    lines += [*(guess.lines if guess else calibgraph.describe_rig(made)), *notes]
    end = f"{out}: written" if out is not None else "nothing was written; --out writes the rig"
    print_line(*lines, f"{end}; check the sentences above against the vehicle")


def _is_to_fill_in(path: Path) -> bool:
    """Whether a source is a folder without a rig, or with one such as this command writes."""
    from calibgraph.io.bags.storage import is_bag
    from calibgraph.io.rigs import RIG_FILE, find_rig_file

    return path.is_dir() and not is_bag(path) and find_rig_file(path) in (None, path / RIG_FILE)


def _parse_file(text: str) -> tuple[str, Path]:
    """The camera's name, if there is one before ``=``, and the file."""
    name, equals, file = text.partition("=")
    return (name, Path(file)) if equals and not Path(text).exists() else ("", Path(text))


def _size_px(size: str | None) -> tuple[int, int] | None:
    """Width and height of images whose file has none."""
    match = re.fullmatch(r"(\d+)x(\d+)", size or "")
    if size is not None and match is None:
        raise ValueError(f"--size {size!r}: give WIDTHxHEIGHT, as 1920x1200")
    return match and (int(match[1]), int(match[2]))


def _rig_of_files(
    source: list[str], mount: list[str] | None, *, forward: str, size_px: tuple[int, int] | None,
    **options: Any,
) -> tuple[calibgraph.Rig, list[str], calibgraph.RigGuess | None]:  # fmt: skip
    """The rig, notes on it, and how good its guess is, where cameras are described.

    The other options are those of :func:`read_rig_parts`.
    """
    from calibgraph.io.formats.rig_import import read_rig_parts

    named, mountings = [_parse_file(text) for text in source], parse_names("--mount", mount)
    parts = read_rig_parts(
        [file for _, file in named], names={file: name for name, file in named if name}, **options
    )
    notes = [f"note: {note}" for note in parts.notes]
    if not mountings:
        return parts.to_rig(size_px=size_px), notes, None
    guess = calibgraph.guess_rig(parts, mountings=mountings, forward=forward, size_px=size_px)
    return guess.rig, notes, guess


def _rig_of_bags(
    paths: list[Path], topic: list[str] | None
) -> tuple[calibgraph.Rig, list[str], list[dict[str, Any]]]:
    """The rig of the first bag, notes on it, and its topics; the others serve where it lacks."""
    from calibgraph.io.bags.messages import Bag
    from calibgraph.io.bags.rig import doubtful_axes, read_bag_rig

    topics = sorted(Bag(paths[0]).topics.values(), key=lambda each: each.name)
    read = read_bag_rig(paths[0], bag_settings(None, topic, beside=tuple(paths[1:]) or None))
    made = read.to_rig()
    listed = [{"topic": each.name, "type": each.type, "messages": each.count} for each in topics]
    return made, [*doubtful_axes(made), *read.notes], listed


def _write_template(
    folder: Path, out: Path | None, mount: list[str] | None, lens: list[str] | None, **options: Any
) -> None:
    """Write the rig of a folder, with what is left to fill in, and say what comes next."""
    from calibgraph.guessing.mounting import CALIBRATION
    from calibgraph.guessing.template import cameras_of_folder
    from calibgraph.io.dataset_folders import describe_pairing

    with checked_arguments():
        words = parse_names("--mount", mount)
        known = _lenses(lens, [*cameras_of_folder(folder)])
        path = calibgraph.write_rig_template(folder, out, mountings=words, lenses=known, **options)
        pairing = describe_pairing(folder)
    if pairing:
        print_line(pairing)
    left = "FILL_IN" in path.read_text(encoding="utf-8").partition("\nformat:")[2]
    where = join([str(folder), *([] if out is None else ["--rig", str(out)])])
    first = "replace every FILL_IN; then" if left else "next"
    print_line(f"{path}: written; {first}: calibgraph doctor {where}")
    if any(how != CALIBRATION for how in known.values()):
        print_line(
            "a lens from a spec sheet or a field of view is known to 2 %, so estimate it: "
            f"calibgraph calibrate {where} --estimate lens",
        )


def _lenses(given: list[str] | None, cameras: list[str]) -> dict[str, str]:
    """How the lens of each camera is known, as given for all or one."""
    from calibgraph.guessing.mounting import CALIBRATION

    for_all = [how for how in given or () if "=" not in how]
    named = parse_names("--lens", [how for how in given or () if "=" in how])
    return dict.fromkeys(cameras, for_all[-1] if for_all else CALIBRATION) | named

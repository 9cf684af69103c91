"""The command about ROS bags: what is in one, and the rig that it describes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli.arguments import bag_options_from, checked_arguments
from calibgraph.cli.options import JsonOption, TopicOption
from calibgraph.cli.terminal import print_json, print_plain, terminal

if TYPE_CHECKING:
    from calibgraph.model.rig import Rig


def bag(
    path: Annotated[
        Path, typer.Argument(metavar="BAG", help="ROS 1 bag, or ROS 2 bag: its folder or file.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.yaml", help="Rig file to write: the lenses and the guess."),
    ] = None,
    topic: TopicOption = None,
    tie_deg: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            metavar="DEG",
            help="Take the cameras' relative poses in /tf_static as measured, with this sigma per "
            "axis; with --tie-m. (default: they are only a guess)",
        ),
    ] = None,
    tie_m: Annotated[
        float | None,
        typer.Option(min=1e-5, metavar="M", help="The sigma in translation, per axis."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the topics of a ROS bag, and write its rig: camera_info and /tf_static."""
    from calibgraph.io.bags.rig import doubtful_axes, read_bag_rig
    from calibgraph.io.formats.describe import describe_rig
    from calibgraph.model.plausibility import find_implausible
    from calibgraph.outputs import yaml_mark

    with checked_arguments():
        sigmas = _sigmas(tie_deg, tie_m)
        options = bag_options_from(topic)
    topics = _topics(path)
    if not as_json:
        for name, kind, count in topics:
            print_plain(terminal(), f"{name}  {kind}  {count}")
    read = read_bag_rig(path, options)
    rig = read.to_rig(sigmas)
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

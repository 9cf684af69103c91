"""The command that makes data with a known truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.options import SeedOption
from calibgraph.cli.terminal import progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.model.rig import Rig

STREET = "street"
RIG, BEAMS, STEP_M = "kitti", 64, 4.0  # defaults of simulate_street, but for the rig
_street_option = partial(typer.Option, rich_help_panel="Scenario street")


@dataclass(frozen=True, kw_only=True)
class StreetOptions:
    """What only the scenario street has.

    Attributes:
        sensor_errors: Of the LiDAR: 0 for an ideal one, 1 for errors as real ones have them: beam
            angles and widths, motion during a turn, ranges on dark surfaces. (default: 0)
        vary_layout: Draw also the street's width, curves, gardens and heights by the seed;
            otherwise all streets are laid out alike.
    """

    rig: Annotated[
        str | None,
        _street_option(
            metavar="NAME|RIG",
            help="kitti, walkley (stereo pairs), surround (six cameras), fisheye (four), omni "
            "(two that see more than a half-space), panorama (one that sees all round), sample "
            f"(three small ones), or a rig file; its extrinsics are the truth. (default: {RIG})",
        ),
    ] = None
    beams: Annotated[
        int | None,
        _street_option(
            metavar="16|32|64|128",
            help=f"Of the LiDAR; 32: ahead and to the left only. (default: {BEAMS})",
        ),
    ] = None
    step_m: Annotated[
        float | None,
        _street_option(
            help=f"Mean distance between frames. (default: {STEP_M:g})",
        ),
    ] = None
    sensor_errors: Annotated[float | None, _street_option()] = None
    vary_layout: Annotated[bool, _street_option()] = False

    @property
    def given(self) -> dict[str, Any]:
        """The values of the options that are given, by name."""
        values = vars(self).items()
        return {name: value for name, value in values if value is not None and value is not False}


def simulate(
    scenario: str,
    out: Annotated[Path, typer.Option()],
    *,
    frames: int = 10,
    rotation_deg: Annotated[float, typer.Option(min=0)] = 5.0,
    translation_m: Annotated[float, typer.Option(min=0)] = 0.3,
    seed: SeedOption = 0,
    street: StreetOptions,
) -> None:
    """Simulate data with a known truth, reference.yaml, and a displaced guess, rig.yaml.

    Args:
        scenario (SCENARIO): street: a dataset of scans and images of a drive along a procedural
            street. kitti, walkley, surround, fisheye: a table of correspondences, with the errors
            of the paper's matcher (kitti, walkley) or in between.
        out (DIR): Folder to write.
        frames: Number of frames.
        rotation_deg: Rotation error of the guess, rig.yaml.
        translation_m: Translation error of the guess.
    """
    from calibgraph.simulation.recording import simulate_street
    from calibgraph.simulation.scenarios import simulate_table

    common: dict[str, Any] = {
        "frames": frames, "rotation_deg": rotation_deg, "translation_m": translation_m, "seed": seed
    }  # fmt: skip
    with progress_bar() as progress, checked_arguments():
        if scenario == STREET:
            given = {"rig": RIG, **street.given}
            rig = _rig(given.pop("rig"))
            written = simulate_street(out, rig, **given, **common, progress=progress)
        else:
            _refuse_options_of_street(scenario, [*street.given])
            written = simulate_table(out, scenario, **common)
    for path in written:
        terminal().print(f"{path}: written", soft_wrap=True, markup=False, highlight=False)


def _refuse_options_of_street(scenario: str, given: Sequence[str]) -> None:
    from calibgraph.simulation.scenarios import scenario_of

    named = [f"--{name.replace('_', '-')}" for name in given]
    if named and scenario_of(scenario):
        raise ValueError(
            f"scenario {scenario!r} has its own rig and matcher, {' and '.join(named)} "
            f"would change nothing; leave it out, or simulate {STREET!r}"
        )


def _rig(name: str) -> Rig:
    """A rig by its name, or from a file."""
    from calibgraph.io.rigs import load_rig
    from calibgraph.simulation.rigs import RIG_NAMES, rig_of

    if name and name not in RIG_NAMES and Path(name).exists():
        return load_rig(name)
    return rig_of(name)

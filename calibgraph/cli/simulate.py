"""The command that makes data with a known truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.options import SeedOption
from calibgraph.cli.terminal import progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.model.rig import Rig

STREET = "street"
SURROUNDINGS = STREET, "meadow", "motorway", "tunnel", "deck", "quay"
RIG, BEAMS, STEP_M = "kitti", 64, 4.0  # defaults of the street
_STREET = "Scenario street"


def simulate(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO",
            help="street: a dataset of scans and images of a drive along a procedural street. "
            "kitti, walkley, surround, fisheye: a table of correspondences, with the errors of the "
            "paper's matcher (kitti, walkley) or in between.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")],
    rig: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|RIG",
            help="kitti, walkley (stereo pairs), surround (six cameras), fisheye (four), omni "
            "(two that see more than a half-space), panorama (one that sees all round), sample "
            f"(three small ones), or a rig file; its extrinsics are the truth. (default: {RIG})",
            rich_help_panel=_STREET,
        ),
    ] = None,
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 10,
    rotation_deg: Annotated[
        float, typer.Option(min=0, help="Rotation error of the guess, rig.yaml.")
    ] = 5.0,
    translation_m: Annotated[
        float, typer.Option(min=0, help="Translation error of the guess.")
    ] = 0.3,
    seed: SeedOption = 0,
    beams: Annotated[
        int | None,
        typer.Option(
            metavar="16|32|64|128",
            help=f"Of the LiDAR; 32: ahead and to the left only. (default: {BEAMS})",
            rich_help_panel=_STREET,
        ),
    ] = None,
    step_m: Annotated[
        float | None,
        typer.Option(
            help=f"Mean distance between frames. (default: {STEP_M:g})",
            rich_help_panel=_STREET,
        ),
    ] = None,
    sensor_errors: Annotated[
        float | None,
        typer.Option(
            help="Of the LiDAR: 0 for an ideal one, 1 for errors as real ones have them: beam "
            "angles and widths, motion during a turn, ranges on dark surfaces. (default: 0)",
            rich_help_panel=_STREET,
        ),
    ] = None,
    lens_errors: Annotated[
        float | None,
        typer.Option(
            help="Of the lenses in the rig files: 0 for exact ones, 1 for errors that a good "
            "calibration with a target leaves. (default: 0)",
            rich_help_panel=_STREET,
        ),
    ] = None,
    vary_layout: Annotated[
        bool,
        typer.Option(
            "--vary-layout",
            help="Draw also the street's width, curves, gardens and heights by the seed; "
            "otherwise all streets are laid out alike.",
            rich_help_panel=_STREET,
        ),
    ] = False,
    surroundings: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(SURROUNDINGS),
            help="What the road leads through; all but a street have little to calibrate by. "
            f"(default: {STREET})",
            rich_help_panel=_STREET,
        ),
    ] = None,
) -> None:
    """Simulate data with a known truth, reference.yaml, and a displaced guess, rig.yaml."""
    from calibgraph.simulation.recording import simulate_street
    from calibgraph.simulation.scenarios import simulate_table

    with progress_bar() as progress, checked_arguments():
        if scenario == STREET:
            written = simulate_street(
                out,
                _rig(RIG if rig is None else rig),
                beams=BEAMS if beams is None else beams,
                frames=frames,
                step_m=STEP_M if step_m is None else step_m,
                seed=seed,
                rotation_deg=rotation_deg,
                translation_m=translation_m,
                sensor_errors=0.0 if sensor_errors is None else sensor_errors,
                lens_errors=0.0 if lens_errors is None else lens_errors,
                vary_layout=vary_layout,
                surroundings=STREET if surroundings is None else surroundings,
                progress=progress,
            )
        else:
            of_street = {
                "--rig": rig, "--beams": beams, "--step-m": step_m,
                "--sensor-errors": sensor_errors, "--lens-errors": lens_errors,
                "--vary-layout": vary_layout or None, "--surroundings": surroundings,
            }  # fmt: skip
            _refuse_options_of_street(scenario, of_street)
            written = simulate_table(
                out,
                scenario,
                frames=frames,
                rotation_deg=rotation_deg,
                translation_m=translation_m,
                seed=seed,
            )
    for path in written:
        terminal().print(f"{path}: written", soft_wrap=True, markup=False, highlight=False)


def _refuse_options_of_street(scenario: str, given: Mapping[str, object]) -> None:
    from calibgraph.simulation.scenarios import scenario_of

    named = [option for option, value in given.items() if value is not None]
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

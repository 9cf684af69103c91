"""The command that makes data with a known truth."""

from pathlib import Path
from typing import Any

from typer import Argument, Option

from calibgraph.cli import options
from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.terminal import print_line, progress_bar

STREET = "street"
RIG, BEAMS, STEP_M = "kitti", 64, 4.0  # defaults of simulate_street, but for the rig
_PANEL = "Scenario street"


def simulate(
    scenario: str = Argument(
        ...,
        metavar="SCENARIO",
        help="street: a dataset of scans and images of a drive along a procedural street. "
        "kitti, walkley: a table of correspondences, with the errors of the paper's matcher.",
    ),
    out: Path = Option(..., metavar="DIR", help="Folder to write."),
    frames: int = Option(10, help="Number of frames."),
    rotation_deg: float = Option(5.0, min=0, help="Rotation error of the guess, rig.yaml."),
    translation_m: float = Option(0.3, min=0, help="Translation error of the guess."),
    seed: options.Seed = 0,
    rig: str | None = Option(
        None,
        metavar="NAME|RIG",
        rich_help_panel=_PANEL,
        help="kitti, walkley (stereo pairs), surround (six cameras), fisheye (four), omni "
        "(two that see more than a half-space), panorama (one that sees all round), sample "
        f"(three small ones), or a rig file; its extrinsics are the truth. (default: {RIG})",
    ),
    beams: int | None = Option(
        None,
        metavar="16|32|64|128",
        rich_help_panel=_PANEL,
        help=f"Of the LiDAR. (default: {BEAMS})",
    ),
    step_m: float | None = Option(
        None, rich_help_panel=_PANEL, help=f"Mean distance between frames. (default: {STEP_M:g})"
    ),
    sensor_errors: float | None = Option(
        None, rich_help_panel=_PANEL, help="Of the LiDAR: 1 for those of real ones. (default: 0)"
    ),
    vary_layout: bool = Option(
        False, "--vary-layout", rich_help_panel=_PANEL, help="Draw the street's layout by the seed."
    ),
) -> None:
    """Simulate data with a known truth, reference.yaml, and a displaced guess, rig.yaml."""
    from calibgraph.io.rigs import load_rig
    from calibgraph.simulation.recording import simulate_street
    from calibgraph.simulation.rigs import RIG_NAMES, rig_of
    from calibgraph.simulation.scenarios import SCENARIOS, simulate_table

    common: dict[str, Any] = {
        "frames": frames, "rotation_deg": rotation_deg, "translation_m": translation_m, "seed": seed
    }  # fmt: skip
    of_street: dict[str, Any] = {
        "rig": rig, "beams": beams, "step_m": step_m, "sensor_errors": sensor_errors,
        "vary_layout": vary_layout or None,
    }  # fmt: skip
    street = {name: value for name, value in of_street.items() if value is not None}
    with progress_bar() as progress, checked_arguments():
        if scenario == STREET:
            name = street.pop("rig", RIG)
            is_file = name not in RIG_NAMES and name and Path(name).exists()
            truth = load_rig(name) if is_file else rig_of(name)
            written = simulate_street(out, truth, **street, **common, progress=progress)
        elif street and scenario in SCENARIOS:
            named = " and ".join(f"--{name.replace('_', '-')}" for name in street)
            raise ValueError(
                f"scenario {scenario!r} has its own rig and matcher, {named} would change nothing; "
                f"leave it out, or simulate {STREET!r}"
            )
        else:
            written = simulate_table(out, scenario, **common)
    for path in written:
        print_line(f"{path}: written")

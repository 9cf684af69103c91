"""Groups of options that several commands share; a field per option."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from calibgraph.cli import options
from calibgraph.cli.arguments import (
    bag_options_from,
    config_from,
    dataset_from,
    matcher_from,
    terms_from,
)

if TYPE_CHECKING:
    from calibgraph.io.bags import BagOptions
    from calibgraph.io.dataset import Dataset
    from calibgraph.matching.protocol import Matcher
    from calibgraph.model.config import Config, Terms


SEARCH_LIMIT_S = 1800.0
_structure_option = partial(typer.Option, rich_help_panel="Matcher structure")
_cmrnext_option = partial(typer.Option, rich_help_panel=options.CMRNEXT)
_bag_option = partial(typer.Option, rich_help_panel=options.BAGS)
_OF_BAGS = ("topic", "every_s", "tolerance_s", "stamps", "motion")


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """Which frames of a dataset are taken, with which rig, and how bags are read."""

    rig: options.RigOption = None
    frames: options.FramesOption = None
    topic: options.TopicOption = None
    every_s: Annotated[
        float | None,
        _bag_option(
            min=0.001,
            metavar="SECONDS",
            help="One frame in this time; only its surroundings are read. (default: all frames)",
        ),
    ] = None
    tolerance_s: Annotated[
        float | None,
        _bag_option(
            min=0,
            metavar="SECONDS",
            help="Largest difference of the stamps of a cloud and its images. (default: 0.05)",
        ),
    ] = None
    stamps: Annotated[
        str | None,
        _bag_option(
            metavar="header|record",
            help="Stamps of the sensors, or of recording. (default: header)",
        ),
    ] = None
    motion: options.MotionOption = None

    @property
    def bag(self) -> BagOptions | None:
        """How bags are read; None if no option is given."""
        return bag_options_from(**{name: getattr(self, name) for name in _OF_BAGS})


@dataclass(frozen=True, kw_only=True)
class MatchingOptions(DatasetOptions):
    """Which frames are matched from which guess, and how."""

    matcher: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE", help="structure, cmrnext, or a table of correspondences."
        ),
    ] = "structure"
    interval_s: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Time between neighbouring clouds of a folder: the motion of the LiDAR is found "
            "by their registration. For --estimate offset or readout. (default: unknown)",
        ),
    ] = None
    time_limit_s: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            metavar="SECONDS",
            help="Stop matching after this time; a result of fewer rounds is marked as partial. "
            "[default: 1800 with structure, else none; inf for none]",
        ),
    ] = None
    search_deg: Annotated[
        str | None,
        _structure_option(
            metavar="DEG|none",
            help="Largest rotation error of the guess, per axis; none: no search, for a guess "
            "within about 2.5 deg and 25 cm. The guess itself is tried first. (default: 20)",
        ),
    ] = None
    search_m: Annotated[
        str | None,
        _structure_option(
            "--search-m",
            metavar="M|none",
            help="Largest translation error of the guess, per axis; or none. (default: 1.5)",
        ),
    ] = None
    window_weights: Annotated[
        str | None,
        _structure_option(
            metavar="FILE|none",
            help="Weights of windows of train-windows, in place of the package's; none: all "
            "windows count alike.",
        ),
    ] = None
    weights: options.WeightsOption = None
    start_from: Annotated[
        str | None,
        _cmrnext_option(
            metavar="frame|joint",
            help="Where a network starts: at each frame's own pose by the network before, or at "
            "the joint solve. (default: frame)",
        ),
    ] = None
    device: options.DeviceOption = None
    iterations: Annotated[
        int | None,
        _cmrnext_option(
            min=1, max=1000, help="Iterations of each network's recurrent update (default: 12)."
        ),
    ] = None
    half_resolution: Annotated[
        bool | None,
        _cmrnext_option(
            "--half-resolution/--full-resolution",
            help="Halve the images or not (default: as stored with the weights, else from 1400 px "
            "width on).",
        ),
    ] = None
    occlusion_filter: Annotated[
        bool | None,
        _cmrnext_option(
            "--occlusion-filter", help="Leave out points that nearer surfaces occlude."
        ),
    ] = None
    batch: Annotated[
        int | None,
        _cmrnext_option(min=1, help="Images per batch (default: 1 on a CPU, 4 on a GPU)."),
    ] = None

    @property
    def limit_s(self) -> float | None:
        """The time limit, by default the search's. Networks may need hours on a CPU."""
        default = SEARCH_LIMIT_S if self.matcher == "structure" else None
        return default if self.time_limit_s is None else self.time_limit_s

    def find_matcher(self, *, seed: int) -> Matcher:
        """The matcher; see :func:`calibgraph.cli.arguments.matcher_from`."""
        own = ("rig", "matcher", "frames", "interval_s", "time_limit_s", "weights", *_OF_BAGS)
        others = {name: value for name, value in vars(self).items() if name not in own}
        chosen = self.frames is not None or self.every_s is not None
        return matcher_from(self.matcher, self.weights, seed=seed, all_frames=chosen, **others)

    def load_dataset(self, folders: list[Path]) -> Dataset:
        """The chosen frames of these folders."""
        return dataset_from(folders, self.rig, self.frames, self.bag, interval_s=self.interval_s)


@dataclass(frozen=True, kw_only=True)
class SolveOptions:
    """The settings of a solve."""

    terms: Annotated[
        str,
        typer.Option(metavar="full|reprojection|priors|stage1", help="Terms of the objective."),
    ] = "full"
    preset: options.PresetOption = None
    config: options.ConfigOption = None
    seed: options.ConfigSeedOption = None
    bootstrap: Annotated[
        int | None,
        typer.Option(
            min=2,
            max=100_000,
            help="Check the covariance: solve N times with frames drawn with replacement.",
        ),
    ] = None
    tolerance_deg: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="Rotation by which a PASS may be off; by default 0.5."),
    ] = None
    tolerance_cm: Annotated[
        float | None,
        typer.Option(metavar="CM", help="Distance by which a PASS may be off; by default 10."),
    ] = None
    of: Annotated[
        str | None,
        typer.Option(
            "--of",
            metavar="alignment|mount",
            help="Poses to report: where the LiDAR's points meet the images, or where the sensors "
            "are mounted, less certain. (default: alignment)",
        ),
    ] = None
    estimate: Annotated[
        str | None,
        typer.Option(
            metavar="PART,...",
            help="Estimate each camera's lens and clock too: focal, aspect, centre, distortion, or "
            "lens for all but aspect; offset, readout, or clock for both. The rig may state how "
            "well they are known.",
        ),
    ] = None

    def checked(self, **further: float | None) -> tuple[Config, Terms]:
        """The settings, with further ones of a command, and the terms of the objective."""
        given = {name: value for name, value in vars(self).items() if name != "terms"}
        config, preset = given.pop("config"), given.pop("preset")
        return config_from(config, preset, **given, **further), terms_from(self.terms)


def expand_groups(command: Callable[..., None]) -> Callable[..., None]:
    """A command with the options of its groups in the place of each parameter of such a class."""
    hints = get_type_hints(command, include_extras=True)
    groups = {name: hint for name, hint in hints.items() if is_dataclass(hint)}

    @wraps(command)
    def run(**values: Any) -> None:
        for name, group in groups.items():
            own = {field.name: values.pop(field.name) for field in fields(group)}
            values[name] = group(**own)  # type: ignore[operator]
        command(**values)

    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        keyword = parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        parameters += _options_of(groups[name]) if name in groups else [keyword]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def _options_of(group: Any) -> list[inspect.Parameter]:
    """A parameter per field."""
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(group)
    ]

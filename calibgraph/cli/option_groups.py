"""Groups of options that several commands share; a field per option."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    """Which frames of a dataset are taken, with which rig, and how bags are read.

    Attributes:
        every_s (SECONDS): One frame in this time; only its surroundings are read. (default: all
            frames)
        tolerance_s (SECONDS): Largest difference of the stamps of a cloud and its images. (default:
            0.05)
        stamps (header|record): Stamps of the sensors, or of recording. (default: header)
    """

    rig: Path | None = None
    frames: str | None = None
    topic: options.TopicOption = None
    every_s: Annotated[float | None, _bag_option(min=0.001)] = None
    tolerance_s: Annotated[float | None, _bag_option(min=0)] = None
    stamps: Annotated[str | None, _bag_option()] = None
    motion: options.MotionOption = None

    @property
    def bag(self) -> BagOptions | None:
        """How bags are read; None if no option is given."""
        return bag_options_from(**{name: getattr(self, name) for name in _OF_BAGS})


@dataclass(frozen=True, kw_only=True)
class MatchingOptions(DatasetOptions):
    """Which frames are matched from which guess, and how.

    Attributes:
        matcher (NAME|FILE): structure, cmrnext, or a table of correspondences.
        interval_s (SECONDS): Time between neighbouring clouds of a folder: the motion of the LiDAR
            is found by their registration. For --estimate offset or readout. (default: unknown)
        time_limit_s (SECONDS): Stop matching after this time; a result of fewer rounds is marked as
            partial. (default: 1800 with structure, else none; inf for none)
        search_deg (DEG|none): Largest rotation error of the guess, per axis; none: no search, for a
            guess within about 2.5 deg and 25 cm. The guess itself is tried first. (default: 20)
        search_m (M|none): Largest translation error of the guess, per axis; or none. (default: 1.5)
        start_from (frame|joint): Where a network starts: at each frame's own pose by the network
            before, or at the joint solve. (default: frame)
        iterations: Iterations of each network's recurrent update (default: 12).
        half_resolution: Halve the images or not (default: as stored with the weights, else from
            1400 px width on).
        batch: Images per batch (default: 1 on a CPU, 4 on a GPU).
    """

    matcher: str = "structure"
    interval_s: float | None = None
    time_limit_s: Annotated[float | None, typer.Option(min=0.001)] = None
    search_deg: Annotated[str | None, _structure_option()] = None
    search_m: Annotated[str | None, _structure_option()] = None
    weights: options.WeightsOption = None
    start_from: Annotated[str | None, _cmrnext_option()] = None
    device: options.DeviceOption = None
    iterations: Annotated[int | None, _cmrnext_option(min=1, max=1000)] = None
    half_resolution: Annotated[
        bool | None, _cmrnext_option("--half-resolution/--full-resolution")
    ] = None
    batch: Annotated[int | None, _cmrnext_option(min=1)] = None

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
    """The settings of a solve.

    Attributes:
        terms (full|reprojection|priors|stage1): Terms of the objective.
        bootstrap: Check the covariance: solve N times with frames drawn with replacement.
        tolerance_deg (DEG): Rotation by which a PASS may be off; by default 0.5.
        tolerance_cm (CM): Distance by which a PASS may be off; by default 10.
        of (alignment|mount): Poses to report. alignment: for projecting points. mount: the physical
            pose, with a wider error bar. (default: alignment)
        estimate (PART,...): Estimate each camera's lens and clock too: focal, centre,
            distortion, or lens for all; offset, readout, or clock for both. The rig may
            state how well they are known.
    """

    terms: str = "full"
    preset: str | None = None
    config: Path | None = None
    seed: options.ConfigSeedOption = None
    bootstrap: Annotated[int | None, typer.Option(min=2, max=100_000)] = None
    tolerance_deg: float | None = None
    tolerance_cm: float | None = None
    of: str | None = None
    estimate: str | None = None

    def checked(self, **further: float | None) -> tuple[Config, Terms]:
        """The settings, with further ones of a command, and the terms of the objective."""
        given = {name: value for name, value in vars(self).items() if name != "terms"}
        config, preset = given.pop("config"), given.pop("preset")
        return config_from(config, preset, **given, **further), terms_from(self.terms)

"""The options of matching, which ``calibrate`` and ``match`` share."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

from calibgraph.cli import options
from calibgraph.cli.arguments import bag_options_from, dataset_from, matcher_from

if TYPE_CHECKING:
    from calibgraph.io.dataset import Dataset
    from calibgraph.matching.protocol import Matcher


SEARCH_LIMIT_S = 1800.0
_OF_BAGS = ("topic", "every_s", "tolerance_s", "stamps", "motion")


@dataclass(frozen=True, kw_only=True)
class MatchingOptions:
    """Which frames are matched from which guess, and how; a field per option."""

    rig: options.RigOption = None
    matcher: options.MatcherOption = "structure"
    frames: options.FramesOption = None
    interval_s: options.IntervalOption = None
    time_limit_s: options.TimeLimitOption = None
    search_deg: options.SearchDegOption = None
    search_m: options.SearchMetresOption = None
    window_weights: options.WindowWeightsOption = None
    weights: options.WeightsOption = None
    start_from: options.StartFromOption = None
    device: options.DeviceOption = None
    iterations: options.IterationsOption = None
    half_resolution: options.HalfOption = None
    occlusion_filter: options.OcclusionOption = None
    batch: options.BatchOption = None
    topic: options.TopicOption = None
    every_s: options.EverySecondsOption = None
    tolerance_s: options.ToleranceOption = None
    stamps: options.StampsOption = None
    motion: options.MotionOption = None

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
        bag = bag_options_from(**{name: getattr(self, name) for name in _OF_BAGS})
        return dataset_from(folders, self.rig, self.frames, bag, interval_s=self.interval_s)


def with_matching_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command with :class:`MatchingOptions`, in the place of its parameter ``matching``."""
    hints = get_type_hints(MatchingOptions, include_extras=True)
    names = [field.name for field in fields(MatchingOptions)]
    added = [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default,
            annotation=hints[field.name],
        )
        for field in fields(MatchingOptions)
    ]  # fmt: skip

    @wraps(command)
    def run(**values: Any) -> None:
        matching = MatchingOptions(**{name: values.pop(name) for name in names})
        command(**values, matching=matching)

    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        keyword = parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        parameters += added if parameter.name == "matching" else [keyword]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run

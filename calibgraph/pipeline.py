"""From images and clouds to a calibration: match, solve, and match again from the estimate."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from calibgraph.calibration import Calibration
from calibgraph.check import Check
from calibgraph.config import Config, Terms
from calibgraph.correspondence_file import load_correspondences
from calibgraph.correspondences import Correspondences
from calibgraph.dataset import Dataset, load_dataset
from calibgraph.errors import CorrespondenceError
from calibgraph.files import sha256
from calibgraph.problem import Clock, Fit
from calibgraph.progress import Progress, silent
from calibgraph.rig import Rig
from calibgraph.second_look import (
    Matched,
    better_reading,
    matched_again,
    round_of,
    second_look,
)
from calibgraph.two_pass import fit, judged

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Start:
    """Where a matcher's rounds begin.

    Attributes:
        rig: with the poses to begin from.
        first_round: with which round.
        metadata: what the tables of the rounds say besides.
    """

    rig: Rig
    first_round: int = 0
    metadata: Mapping[str, Any] = field(default_factory=dict)


class Matcher(Protocol):
    """What finds correspondences. It may want several rounds, each from a better estimate.

    The verdict heeds what the metadata of its tables says, each a mapping of camera names:
    ``contrast``: by how many chance spreads the matches' agreement stands out;
    ``start_dependence``: which share of a displaced start remains in the matches (0 to 1);
    ``recall``: which share of the way back it finds without the image (0 to 1);
    ``failed_share``: which share of the frames it left out (0 to 1);
    ``found``, ``missed``: by how many chance spreads image and cloud agree where its search found
    a camera, or at best where it did not: such a camera fails.
    Two plain numbers say how far from the guess it looks, per axis: ``range_rotation_deg`` and
    ``range_translation_m``; two more what error its frames share, see ``Correspondences``.

    It may have an attribute ``tracking_rounds``: which of its rounds to go through near a good
    estimate. Single frames of a drive go through these (otherwise through all), and a result is
    tried by matching again with them from a start displaced from it.

    It may have an attribute ``most_frames``: how many frames it is given at most, evenly spread
    over the dataset; None for all.

    It may have a method ``locate(dataset, rig, *, out_of_time, progress)`` that says where the
    rounds begin, a ``Start``, given the guess and a function that says when to hurry.

    Attributes:
        rounds: how many rounds it wants.
        stage1: where the pairwise estimates come from, see ``Config.stage1``.
    """

    rounds: int
    stage1: Literal["pnp", "rig"]

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Find the correspondences of all cameras and frames.

        Args:
            dataset: images and clouds.
            rig: lenses, and the present estimate of the poses.
            round_index: 0 .. rounds - 1.
            progress: to be told how far it is.
        """
        ...


class Precomputed:
    """A matcher that has done its work already: a table, from a file or in memory."""

    rounds = 1
    stage1: Literal["pnp", "rig"] = "pnp"

    def __init__(self, table: Correspondences) -> None:
        self.table = table

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        """Return the rows of the table that belong to the dataset's frames."""
        frames = np.array([frame.index for frame in dataset.frames])
        return self.table.select(np.isin(self.table.frame, frames))


def calibrate(
    dataset: Dataset | Path | str | Sequence[Path | str],
    rig: Rig | None = None,
    matcher: Matcher | Correspondences | Path | str = "structure",
    config: Config | None = None,
    *,
    terms: Terms = "full",
    time_limit_s: float | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate all cameras of a rig jointly from images and clouds.

    Args:
        dataset: a dataset, its folder, a KITTI odometry sequence, or several folders of one rig.
        rig: the initial guess; the rig that lies with the data if None.
        matcher: ``structure``; a matcher of your own; or correspondences, from a file or in memory.
        config: settings of the solve; the preset ``auto`` if None.
        terms: of the objective, see :func:`calibgraph.solve`.
        time_limit_s: when to stop matching; the result then says that it is partial.
        progress: called as the work goes on.

    Returns:
        The calibration, with the correspondences of its last round.

    Raises:
        FileError, DatasetError: if the data cannot be read or do not fit together.
        CorrespondenceError: if a camera gets too few correspondences.
        ValueError: if the matcher is unknown.
    """
    report = progress or silent
    matched = match_in_rounds(
        dataset, rig, matcher, config, terms, time_limit_s=time_limit_s, progress=report
    )
    data, clock = matched.dataset, matched.clock
    with clock("hash_inputs"):
        inputs = _input_hashes(data)
    with clock("checks"):
        result = judged(matched.fit, guess=matched.guess)
        result = result.judged_further(second_look(matched, inputs, report))
        if result.verdict.status == "FAIL" and not matched.out_of_time:
            result = _with_reading(result, better_reading(data, matched.guess))
    report("done", 1, 1)
    return replace(
        result,
        correspondences=matched.table,
        frames=tuple(frame.entry() for frame in data.frames),
        rounds=matched.rounds,
        inputs=inputs,
        timings_s=clock.seconds,
    )


def match_in_rounds(
    dataset: Dataset | Path | str | Sequence[Path | str],
    rig: Rig | None = None,
    matcher: Matcher | Correspondences | Path | str = "structure",
    config: Config | None = None,
    terms: Terms = "full",
    *,
    time_limit_s: float | None = None,
    progress: Progress,
) -> Matched:
    """Match, solve, and match again from the estimate, as often as the matcher wants.

    Then once more from a displaced start, see ``matched_again``. Nothing is judged. Arguments and
    errors as of :func:`calibrate`.
    """
    config = config or Config()
    chosen = matcher_named(matcher, seed=config.seed)
    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset, rig)
    guess = rig if rig is not None else data.rig
    most = getattr(chosen, "most_frames", None)
    data = data if most is None else data.spread_out(most)
    if chosen.stage1 == "rig":
        config = config.changed(stage1="rig", learnt_weights=False)  # weights need frames' poses
    if chosen.rounds < 1:
        raise ValueError(f"the matcher wants {chosen.rounds} rounds, expected at least 1")
    clock, rounds, out_of_time = Clock(), list[dict[str, Any]](), _after(time_limit_s)
    with clock("locate"):
        start = _start(chosen, data, guess, out_of_time, progress)
    estimate = start.rig
    for index in range(start.first_round, chosen.rounds):
        with clock("match"):
            table = chosen.match(data, estimate, round_index=index, progress=progress)
            table = replace(table, metadata={**table.metadata, **start.metadata})
        with clock("solve"):
            found = _fit(data, guess, (estimate, table), config, terms)
        rounds.append(round_of(table, estimate, found.solved_rig))
        estimate = found.solved_rig
        if out_of_time():
            break
    matched = Matched(
        data,
        chosen,
        guess,
        table,
        found,
        tuple(rounds),
        clock,
        missed_rounds=chosen.rounds - 1 - index,
    )
    if not out_of_time():
        with clock("match_again"):
            matched = matched_again(matched, progress, out_of_time)
    return replace(matched, out_of_time=out_of_time())


def _after(seconds: float | None) -> Callable[[], bool]:
    """A function that says whether so many seconds have passed since now."""
    if seconds is not None and not seconds > 0:
        raise ValueError(f"the time limit must be positive, found {seconds} s")
    end = math.inf if seconds is None else time.monotonic() + seconds
    return lambda: time.monotonic() > end


def _start(
    matcher: Matcher,
    dataset: Dataset,
    guess: Rig,
    out_of_time: Callable[[], bool],
    progress: Progress,
) -> Start:
    """Where the rounds begin: at the guess, if the matcher has no say."""
    if not hasattr(matcher, "locate"):
        return Start(guess)
    found: Start = matcher.locate(dataset, guess, out_of_time=out_of_time, progress=progress)
    return found


def _with_reading(result: Calibration, meant: str | None) -> Calibration:
    """A failed result with what its guess may have meant."""
    if meant is None:
        return result
    text = f"the images fit better if the guess is {meant}: correct it and calibrate again"
    check = Check("reading of the guess", "FAIL", text)
    verdicts = {name: v.and_first([check]) for name, v in result.camera_verdicts.items()}
    return replace(result, camera_verdicts=verdicts)


def _input_hashes(dataset: Dataset) -> dict[str, str]:
    """SHA-256 of every cloud and image, by path."""
    files = [
        path for frame in dataset.frames for path in (frame.cloud_path, *frame.image_paths.values())
    ]
    return {str(path): sha256(path) for path in files}


def matcher_named(matcher: Matcher | Correspondences | Path | str, *, seed: int = 0) -> Matcher:
    """A matcher by its name, by the file of its correspondences, or as it is.

    Args:
        matcher: what the user said.
        seed: for a matcher by name that draws random numbers.

    Raises:
        ValueError: if it is a name, but not of a matcher.
        FileError, CorrespondenceError: if it is a file, but not a table.
    """
    if isinstance(matcher, Correspondences):
        return Precomputed(matcher)
    if not isinstance(matcher, (str, Path)):
        return matcher
    if str(matcher) == "structure":
        from calibgraph.structure import StructureMatcher

        return StructureMatcher(seed=seed)
    if Path(matcher).suffix in (".parquet", ".csv"):
        return Precomputed(load_correspondences(matcher))
    if str(matcher) == "cmrnext":
        raise ValueError(
            "the matcher 'cmrnext' needs weights: --weights iter1.tar iter5.tar iter6.tar, or "
            "calibgraph.cmrnext.CmrNextMatcher([...])"
        )
    raise ValueError(
        f"unknown matcher {str(matcher)!r}; known are 'structure', 'cmrnext' and a table of "
        "correspondences (.parquet or .csv)"
    )


def _fit(
    dataset: Dataset,
    guess: Rig,
    matched: tuple[Rig, Correspondences],
    config: Config,
    terms: Terms,
) -> Fit:
    """The two passes; where there is too little to fit, with what the guess may have meant.

    Raises:
        CorrespondenceError: if a camera gets too few correspondences.
    """
    try:
        return fit(*matched, config, terms)
    except CorrespondenceError as error:
        meant = better_reading(dataset, guess)
        if meant is None:
            raise
        hint = f"{error}; the images fit better if the guess is {meant}"
        raise CorrespondenceError(hint, camera=error.camera) from error

"""The rounds: match, solve, match again from the estimate; then once from a displaced start.

The paper matches once and solves once. A local matcher sees only what is near, so it starts
coarse and is run again from every better estimate.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from calibgraph.errors import CalibrationError, CorrespondenceError
from calibgraph.io.dataset import Dataset, keep_frames, load_dataset
from calibgraph.matching.burnt_in import hide_burnt_in
from calibgraph.matching.camera_pairs import PAIR_FRAMES, match_cameras, with_surfaces
from calibgraph.matching.cloud_similarity import find_up
from calibgraph.matching.frame_choice import FrameChoice, choose_frames, without_copies
from calibgraph.matching.named import find_matcher
from calibgraph.matching.places import UNKNOWN_UP, find_places
from calibgraph.matching.protocol import Matcher
from calibgraph.matching.run import (
    MatchingRun,
    RoundSummary,
    require_known_motion,
    round_in_words,
    summarize_round,
    with_motion,
)
from calibgraph.matching.same_images import require_different_images
from calibgraph.matching.standstill import find_stationary_frames
from calibgraph.model.config import Config, Terms
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.lens import LensEstimate, change_of_lens, unsettled
from calibgraph.model.places import Places, as_groups
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress, Stopwatch, with_note
from calibgraph.rematch import rematch
from calibgraph.solver.joint import solve_joint, solve_without_failing
from calibgraph.solver.solution import Solution
from calibgraph.trust.conventions import likely_intended_guess
from calibgraph.trust.inputs import check_inputs, describe_copies

Datasets = Dataset | Path | str | Sequence[Path | str]
AnyMatcher = Matcher | Correspondences | Path | str

_log = logging.getLogger(__name__)

_STANDS, _REPEATS = 0.5, 4
"""Change of a lens or clock, in standard deviations, from which the last round is repeated; how
often."""


def match_in_rounds(
    dataset: Datasets,
    rig: Rig | None = None,
    matcher: AnyMatcher = "structure",
    config: Config | None = None,
    *,
    terms: Terms = "full",
    time_limit_s: float | None = None,
    progress: Progress,
) -> MatchingRun:
    """Match, solve, and match again from the estimate, as often as the matcher wants.

    Then once more from a displaced start, see ``rematch``. Nothing is judged. Arguments and errors
    as of :func:`calibgraph.calibrate`.
    """
    config = config or Config()
    watch, rounds, out_of_time = Stopwatch(), list[RoundSummary](), _deadline(time_limit_s)
    full = find_matcher(matcher, seed=config.seed).with_estimate(config.estimate)
    with watch("choose_frames"):
        choice, guess = _open(dataset, rig, full.most_frames)
    data = choice.dataset
    _log.info("%d frames, cameras %s", len(data.frames), ", ".join(guess.cameras))
    with watch("inputs"):
        require_known_motion(data, full, config.estimate)
        warnings = check_inputs(data, guess, at_guess=full.stage1 == "rig")
    with watch("places"):
        places = find_stationary(data, guess)
    with watch("locate"):
        start = full.locate(data, guess, out_of_time=out_of_time, progress=progress)
    estimate = start.rig
    indices, lens = [*range(start.first_round, full.rounds)], dict[str, tuple[LensEstimate, ...]]()
    for index in indices:
        repeat = len(rounds) + 1 - (full.rounds - start.first_round)
        note = f"{', '.join(config.estimate)}: repeat {repeat}, at most {_REPEATS}"
        told = with_note(progress, note if repeat > 0 else "")
        with watch("match"):
            table = full.match(data, estimate, round_index=index, progress=told)
            table = with_motion(table, data).with_findings(start.findings).with_places(places)
        with watch("solve"):
            solution = _solve(data, guess, (estimate, table), config, terms=terms)
        rounds.append(summarize_round(table, estimate, solution.solved_rig))
        _log.info("round %d: %s", index, round_in_words(rounds[-1]))
        moved, lens = change_of_lens(lens, solution.lens), solution.lens
        estimate = solution.solved_rig
        if index == full.rounds - 1 and moved > _STANDS and repeat < _REPEATS:
            indices.append(index)  # with the new lens
        if out_of_time():
            break
    if moved > _STANDS and repeat == _REPEATS:
        warnings = (*warnings, unsettled(config.estimate, moved, repeat))
    missed = full.rounds - 1 - index
    run = MatchingRun(
        data, full, guess, table, solution, tuple(rounds), watch, missed,
        warnings=warnings, is_late=out_of_time, excluded=config.excluded_cameras,
        copies=choice.copies,
    )  # fmt: skip
    if not out_of_time():
        with watch("match_again"):
            run = rematch(run, progress)
    full.release()
    with watch("places"):
        run = assign_places(run)
    return replace(run, out_of_time=out_of_time())


def assign_places(run: MatchingRun) -> MatchingRun:
    """The run, solved again with the places of its frames.

    Where the matcher's error has a part that frames of one place share. The camera with the highest
    z-score shows where the places are.
    """
    findings, rig = run.correspondences.findings, run.solution.solved_rig
    found = {name: z for name, z in findings.z_score.items() if name not in findings.missed}
    if not findings.place_variance or not found:
        return run
    camera, config = max(found, key=lambda name: found[name]), run.solution.config
    try:
        groups = find_places(run.dataset, rig, camera, seed=config.seed)
        up = find_up(run.dataset.frames[0].load_cloud(), rig.T_camera_lidar.values())
    except (CalibrationError, OSError):  # the checks on images report it
        return run
    places = replace(run.correspondences.places, places=as_groups(groups))
    table = run.correspondences.with_places(places)
    solution = solve_joint(
        run.solution.rig.with_lenses_of(run.guess),
        table,
        config,
        run.solution.terms,
        camera_matches=run.solution.camera_matches,
    )
    warnings = run.warnings if up is not None else (*run.warnings, UNKNOWN_UP)
    return replace(run, correspondences=table, solution=solution, warnings=warnings)


def _open(dataset: Datasets, rig: Rig | None, most_frames: int | None) -> tuple[FrameChoice, Rig]:
    """The frames that the matcher is given, and the initial guess."""
    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset, rig)
    guess = rig if rig is not None else data.rig
    data = keep_frames(data)
    require_different_images(data, guess)
    data = keep_frames(hide_burnt_in(data, guess))
    if most_frames is None:
        choice = without_copies(data)
    else:
        choice = choose_frames(data, guess, most_frames)
    if choice.text:
        _log.info(choice.text)
    if choice.copies:
        _log.info(describe_copies(choice.copies))
    return choice, guess


def find_stationary(data: Dataset, rig: Rig) -> Places:
    """During which frames the vehicle stands."""
    try:
        return Places(stationary=as_groups(find_stationary_frames(data, rig)))
    except (CalibrationError, OSError):  # the checks on images report it
        return Places()


def _deadline(seconds: float | None) -> Callable[[], bool]:
    """A function that returns whether a time limit [s], counted from now, has passed."""
    if seconds is not None and not seconds > 0:
        raise ValueError(f"the time limit must be positive, found {seconds} s")
    end = math.inf if seconds is None else time.monotonic() + seconds
    return lambda: time.monotonic() > end


def _solve(
    dataset: Dataset,
    guess: Rig,
    matched: tuple[Rig, Correspondences],
    config: Config,
    *,
    terms: Terms,
) -> Solution:
    """The joint solve; where there is too little to solve from, with a hint about the guess.

    A camera with too few correspondences is placed by what it sees in common with another; if that
    does not place it either, it is excluded, and the others are calibrated.
    """
    matched = (matched[0].with_lenses_of(guess), matched[1])  # the mean of their priors
    try:
        return solve_joint(*matched, config, terms)
    except CorrespondenceError as error:
        with suppress(CalibrationError, OSError):
            matches = match_cameras(dataset, guess, most_frames=PAIR_FRAMES, seed=config.seed)
            matches = with_surfaces(matches, dataset, matched[0])
            return solve_joint(*matched, config, terms, camera_matches=matches)
        with suppress(CorrespondenceError):
            return solve_without_failing(*matched, config, terms)
        cause = likely_intended_guess(dataset, guess)
        if cause is None and error.camera in matched[1].findings.missed:
            cause = "the search has not found this camera: give more frames, or a nearer guess"
        if cause is None:
            raise
        raise CorrespondenceError(f"{error}; {cause}", camera=error.camera) from error

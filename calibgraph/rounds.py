"""The rounds: match, solve, match again from the estimate; then from other starts.

The paper matches once and solves once. A local matcher sees only what is near, so it starts
coarse and is run again from every better estimate. Rounds from other starts, a displaced one and
those of :func:`go_on_elsewhere`, show whether there is a better end. What cameras see in common
comes last.
"""

import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, CorrespondenceError
from calibgraph.io.dataset import Dataset, keep_frames, load_dataset
from calibgraph.matching.burnt_in import hide_burnt_in
from calibgraph.matching.camera_pairs import (
    PAIR_FRAMES,
    match_cameras,
    overlapping_pairs,
    with_surfaces,
)
from calibgraph.matching.cloud_similarity import find_up
from calibgraph.matching.frame_choice import (
    FrameChoice,
    choose_frames,
    find_stationary_frames,
    without_copies,
)
from calibgraph.matching.named import find_matcher
from calibgraph.matching.places import UNKNOWN_UP, find_places
from calibgraph.matching.protocol import Matcher
from calibgraph.matching.run import (
    MatchingRun,
    RoundSummary,
    require_known_motion,
    round_in_words,
    summarize_round,
    with_delays,
    with_motion,
)
from calibgraph.matching.same_images import require_different_images
from calibgraph.matching.structure.pose_search import are_same_pose
from calibgraph.model.config import Config, Terms
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import invert, pose_difference
from calibgraph.model.lens import LensEstimate, change_of_lens, unsettled
from calibgraph.model.metrics import perturb
from calibgraph.model.places import Places, as_groups
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress, Stopwatch
from calibgraph.solver.joint import add_camera_pairs, solve_joint, solve_without_failing
from calibgraph.solver.solution import Solution
from calibgraph.trust.conventions import likely_intended_guess
from calibgraph.trust.evidence import Evidence, gather_of_run
from calibgraph.trust.inputs import check_inputs, describe_copies
from calibgraph.trust.matcher_checks import REMATCH_DEG, REMATCH_M, check_moves, compare_ends
from factors.columns import CLOCK

Datasets = Dataset | Path | str | Sequence[Path | str]
AnyMatcher = Matcher | Correspondences | Path | str

_log = logging.getLogger(__name__)

_TIMES = 3  # at most: a posterior that its prior cuts off shows the way, not the end
_STARTS = 4  # each time, at most
_STANDS, _REPEATS = 0.5, 4
"""Change of a lens or clock, in standard deviations, from which the last round is repeated; how
often. It is also repeated while it moves a camera that is found beyond what a PASS allows."""
_AT_ONCE_M, _USUAL_M_S = 0.01, 10.0
"""Way between two images from which on they show no relative pose of their cameras; the speed of a
vehicle whose clouds were swept while it drove."""
_BETTER = 1.03
"""Ratio of z-scores from which the end of a displaced start replaces the first end. On KITTI, ends
8 to 12 cm off had 8 to 16 % lower z-scores than those at 3 cm; equally good ends differ by a few
percent."""


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

    Then once more from a displaced start, see :func:`rematch`. Nothing is judged. Arguments and
    errors as of :func:`calibgraph.calibrate`.
    """
    config = config or Config()
    watch, out_of_time, note = Stopwatch(), _deadline(time_limit_s), ""
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
    indices, lens = [*range(start.first_round, full.rounds)], dict[str, tuple[LensEstimate, ...]]()
    planned = len(indices)

    def report(what: str, done: int, total: int) -> None:
        progress(f"{what} ({note})" if note else what, done, total)

    def match(at: Rig, index: int) -> Correspondences:
        with watch("match"):
            table = full.match(data, at, round_index=index, progress=report)
            return with_motion(table, data).with_findings(start.findings).with_places(places)

    def solve(at: Rig, table: Correspondences) -> Solution:
        with watch("solve"):
            return _solve(data, guess, at, table, config=config, terms=terms)

    for table, solution, rounds in run_rounds(start.rig, indices, match, solve):  # noqa: B007
        repeat, index = len(rounds) - planned, indices[len(rounds) - 1]
        _log.info("round %d: %s", index, round_in_words(rounds[-1]))
        moved, lens = change_of_lens(lens, solution.lens), solution.lens
        if out_of_time():
            break
        stands = moved <= _STANDS and not (
            full.tracking_rounds and _moves_on(rounds, table, config)
        )
        if 0 <= repeat < _REPEATS and not stands:
            indices.append(index)  # with the new lens
            note = f"repeat {repeat + 1}, at most {_REPEATS}"
    if moved > _STANDS and repeat == _REPEATS:
        warnings = (*warnings, unsettled(config.estimate, moved, repeat))
    missed = full.rounds - 1 - index
    run = MatchingRun(
        data, full, guess, table, solution, rounds, watch, missed,
        warnings=warnings, is_late=out_of_time, excluded=config.excluded_cameras,
        copies=choice.copies, progress=progress,
    )  # fmt: skip
    if not out_of_time():
        with watch("match_again"):
            run = rematch(run)
    full.release()
    with watch("places"):
        run = assign_places(run)
    return replace(run, out_of_time=out_of_time())


def run_rounds(
    start: Rig,
    indices: Iterable[int],
    match: Callable[[Rig, int], Correspondences],
    solve: Callable[[Rig, Correspondences], Solution],
) -> Iterator[tuple[Correspondences, Solution, tuple[RoundSummary, ...]]]:
    """Match and solve, each round from the estimate of the one before.

    Args:
        start: where the cameras are at first.
        indices: of the rounds; more may be appended on the way.
        match: finds the matches of a round, from where the cameras are.
        solve: these matches, from there.

    Yields:
        After each round its matches, their solution, and the summaries of all rounds so far.

    Raises:
        CorrespondenceError: if a camera gets too few correspondences.
    """
    estimate, rounds = start, tuple[RoundSummary, ...]()
    for index in indices:
        table = match(estimate, index)
        solution = solve(estimate, table)
        rounds = (*rounds, summarize_round(table, estimate, solution.solved_rig))
        estimate = solution.solved_rig
        yield table, solution, rounds


def rematch(run: MatchingRun, *, confirmed: bool = False) -> MatchingRun:
    """Match again from a start displaced from the result, if the matcher names rounds for it.

    Where an objective is flat, as along the axis of a camera in a straight street, rounds may end
    before its top. A camera whose second end has a clearly higher z-score is taken from there. If
    the ends are so far apart that the camera would fail, a start displaced from there decides.
    """
    tracking, findings = run.matcher.tracking_rounds, run.correspondences.findings
    if not tracking or not run.solution.objective.uses_correspondences:
        return run
    run = run if confirmed else follow_neighbours(run)
    ended, rig = run.solution.T_camera_lidar, run.solution.solved_rig
    seed = run.solution.config.seed
    start = perturb(rig, rotation_deg=REMATCH_DEG, translation_m=REMATCH_M, seed=seed)
    try:
        again = run_again(run, start, tracking)
        if again is None:
            return run
        ends = again.solution.T_camera_lidar
        run = replace(run, rematch={name: (T, ends[name]) for name, T in ended.items()})
        lost = {*findings.missed, *again.solution.held}
        found = [(name,) for name in findings.z_score if name not in lost]
        apart = compare_ends(run)
        run, better = take_better(run, again, found, ratio=_BETTER)
        far = any(name in better and check.status == "FAIL" for name, check in apart)
        return rematch(run, confirmed=True) if far and not confirmed else run
    except CorrespondenceError as error:
        both = {name: (T, T) for name, T in ended.items()}
        return replace(run, rematch=both, rematch_failure=str(error))


def follow_neighbours(run: MatchingRun) -> MatchingRun:
    """Match again from where most cameras have gone, those that have left them.

    Where more than half of the cameras keep the relative poses of the guess, the others may have
    ended at a wrong optimum. They start again where the guess has them beside these, and the end at
    which images and clouds agree better is taken.
    """
    guess, ended = run.guess.T_camera_lidar, run.solution.T_camera_lidar
    moves = [invert(guess[name]) @ T for name, T in ended.items()]  # of the cloud, by each camera
    placed = [{name: guess[name] @ move for name in ended} for move in moves]
    left = [[n for n, T in of.items() if not are_same_pose(T, ended[n])] for of in placed]
    fewest = min(range(len(left)), key=lambda k: len(left[k]))
    astray = left[fewest]
    if not 0 < len(astray) < len(ended) / 2:
        return run
    start = run.solution.solved_rig.moved_to({name: placed[fewest][name] for name in astray})
    rounds = (0, *run.matcher.tracking_rounds)
    with suppress(CorrespondenceError):
        if again := run_again(run, start, rounds):
            run, better = take_better(run, again, [(name,) for name in astray])
            if better:
                _log.info("beside their neighbours images and clouds agree better: %s", better)
    return run


def run_again(
    run: MatchingRun,
    start: Rig,
    rounds: Sequence[int],
) -> MatchingRun | None:
    """Some rounds and the last one from another start; None if the time is over before their end.

    Raises:
        CorrespondenceError: if all cameras get too few correspondences.
    """
    settings, places = (run.solution.config, run.solution.terms), run.correspondences.places
    indices = [*dict.fromkeys((*rounds, run.matcher.rounds - 1))]
    most = len(indices) + _REPEATS

    def match(at: Rig, index: int) -> Correspondences:
        table = run.matcher.match(
            run.dataset,
            at,
            round_index=index,
            progress=lambda _, done, total: run.progress("matching again", done, total),
        )
        return with_motion(table, run.dataset).with_places(places)

    done = run_rounds(
        start,
        indices,
        match,
        lambda at, table: solve_without_failing(at.with_lenses_of(run.guess), table, *settings),
    )
    while not run.is_late():
        table, solution, summaries = next(done)
        if len(summaries) < len(indices):
            continue
        if len(indices) == most or not _moves_on(summaries, run.correspondences, settings[0]):
            return replace(run, correspondences=table, solution=solution, rounds=summaries)
        indices.append(indices[-1])
    return None


def _moves_on(rounds: Sequence[RoundSummary], table: Correspondences, config: Config) -> bool:
    """Whether the last of several rounds moved a camera that is found beyond what a PASS allows."""
    missed, checks = table.findings.missed, check_moves(rounds, config.tolerance)
    return any(name not in missed and check.status != "PASS" for name, check in checks)


def take_better(
    run: MatchingRun, again: MatchingRun, groups: Iterable[Sequence[str]], *, ratio: float = 1.0
) -> tuple[MatchingRun, list[str]]:
    """The run with correspondences, starts and summaries of a second end, where it is better.

    Returns:
        The run; the cameras of the groups whose z-scores, added up, are by a ratio higher there.
    """
    before, now = (of.correspondences.findings.z_score for of in (run, again))
    names = [
        name
        for group in groups
        if sum(now.get(n, 0.0) for n in group) > ratio * sum(before.get(n, 0.0) for n in group)
        for name in group
    ]
    if not names:
        return run, names
    parts = [
        (again if name in names else run).correspondences.of_camera(name)
        for name in run.guess.cameras
    ]
    z_score = {**before, **{name: now[name] for name in names if name in now}}
    mixed = concatenate(parts).with_metadata(run.correspondences.metadata)
    mixed = mixed.with_findings(replace(run.correspondences.findings, z_score=z_score))
    second = again.solution.rig.T_camera_lidar
    start = run.solution.rig.with_lenses_of(run.guess)
    start = start.moved_to({name: second[name] for name in names})
    last = {**run.rounds[-1], **{name: again.rounds[-1][name] for name in names}}
    solution = solve_joint(start, mixed, run.solution.config, run.solution.terms)
    rounds = (*run.rounds[:-1], last)
    return replace(run, correspondences=mixed, solution=solution, rounds=rounds), names


def assign_places(run: MatchingRun) -> MatchingRun:
    """The run, solved again with the places of its frames, and when its points were taken.

    Places count where the matcher's error has a part that frames of one place share. The camera
    with the highest z-score shows where they are.
    """
    findings, solution, warnings = run.correspondences.findings, run.solution, run.warnings
    found = {name: z for name, z in findings.z_score.items() if name not in findings.missed}
    rig, config = solution.solved_rig, solution.config
    try:
        table = run.correspondences
        if not config.instant_clouds:
            table = with_delays(table, run.dataset)
        if findings.place_variance and found:
            camera = max(found, key=lambda name: found[name])
            groups = find_places(run.dataset, rig, camera, seed=config.seed)
            table = table.with_places(replace(table.places, places=as_groups(groups)))
            up = find_up(run.dataset.frames[0].load_cloud(), rig.T_camera_lidar.values())
            warnings = warnings if up is not None else (*warnings, UNKNOWN_UP)
    except (CalibrationError, OSError):  # the checks on images report it
        return run
    if table is run.correspondences:
        return run
    start, pairs = solution.rig.with_lenses_of(run.guess), solution.camera_matches
    solution = solve_joint(start, table, config, solution.terms, camera_matches=pairs)
    return replace(run, correspondences=table, solution=solution, warnings=warnings)


def refine_with_camera_pairs(run: MatchingRun) -> MatchingRun:
    """Match the cameras with each other, and refine the solution with what they see in common.

    Not the cameras that the matcher did not find, nor a pair whose features contradict what it
    found: they would spoil the others. Nor two that the vehicle carries on between their images.

    Returns:
        The run itself where no two cameras can overlap, there is no time left, the terms do not use
        the correspondences, or the files, which its matcher may not have needed, cannot be read.
    """
    solution, findings = run.solution, run.correspondences.findings
    if run.out_of_time or not solution.objective.uses_correspondences:
        return run
    try:
        with run.watch("match_cameras"):
            near = overlapping_pairs(solution.solved_rig, run.dataset.frames[0].load_cloud())
            other, missed = findings.contradicted, findings.missed.keys()
            pairs = [(a, b) for a, b in near if missed.isdisjoint((a, b)) and other.get(a) != b]
            pairs = [pair for pair in pairs if _driven_between_m(run, pair) < _AT_ONCE_M]
            if not pairs:
                return run
            matches = match_cameras(
                run.dataset,
                run.guess.with_lenses_of(solution.solved_rig),  # as far as they are estimated
                pairs,
                most_frames=PAIR_FRAMES,
                seed=solution.config.seed,
                progress=run.progress,
            )
        with run.watch("solve_pairs"):
            # Surfaces show where cameras are when they take an image; two cameras each other alone.
            if {*CLOCK}.isdisjoint(solution.config.estimate):
                matches = with_surfaces(matches, run.dataset, solution.solved_rig)
            return replace(run, solution=add_camera_pairs(solution, matches))
    except (CalibrationError, OSError):  # the checks on images report it
        return run


def go_on_elsewhere(run: MatchingRun) -> tuple[MatchingRun, Evidence]:
    """The run, or one whose rounds have gone on from where images agree better; and its evidence.

    Coarse levels can lead the rounds to a pose a degree off, as over grass and asphalt. There fine
    levels agree hardly better than by chance, and find no way back. The posterior of the pose by
    the fine scores covers a degree about the result. If more than half of its mass is elsewhere,
    its densest samples there, farther apart than the tolerance, are starts of the last rounds.
    (Their mean may lie between modes, and the densest alone misses the right one.) The end at which
    the cameras agree best is taken, if it is better than the result.

    The posterior that chose the pose cannot vouch for it: such a camera is WARN at best.
    """
    T_first, evidence = run.solution.T_camera_lidar, gather_of_run(run)
    for _ in range(_TIMES):
        if run.out_of_time or not run.matcher.tracking_rounds:
            break
        found = evidence.posteriors  # of no camera without images, or without a covariance
        groups = [g for g in evidence.tied if g[0] in found and found[g[0]].share > 1 / 2]
        after = _go_on(run, evidence, groups, T_first) if groups else None
        if after is None:
            break
        run, evidence = after, gather_of_run(after)
    return run, evidence


def _go_on(
    run: MatchingRun,
    evidence: Evidence,
    groups: Sequence[tuple[str, ...]],
    T_first: Mapping[str, Array],
) -> MatchingRun | None:
    """The run with the groups that agree better at the end of rounds from there; None if none."""
    samples = {name: found.elsewhere for name, found in evidence.posteriors.items()}
    modes = {g: _find_modes(samples[g[0]], run.solution.config.tolerance) for g in groups}
    T, ended, better = run.solution.T_camera_lidar, run, set[str]()
    with run.watch("match_again"):
        for number in range(max(map(len, modes.values()))):
            start = run.solution.solved_rig.moved_to({
                name: gtsam.Pose3.Expmap(samples[name][found[number]]).matrix() @ T[name]
                for group, found in modes.items()
                for name in (group if number < len(found) else ())
            })  # fmt: skip
            with suppress(CorrespondenceError):
                again = run_again(run, start, run.matcher.tracking_rounds[-1:])
                if again is None:
                    break
                ended, names = take_better(ended, again, groups)
                better.update(names)
    run.matcher.release()
    if not better:
        return None
    T = ended.solution.T_camera_lidar
    moved = {name: pose_difference(T_first[name], T[name]) for name in better}
    _log.info("rounds went on, by deg, cm: %s", moved)
    # Of these the test from a displaced start was of a pose that is no longer the result.
    kept = {name: ends for name, ends in run.rematch.items() if name not in better}
    ended = replace(ended, went_on={**run.went_on, **moved}, rematch=kept)
    return refine_with_camera_pairs(assign_places(ended))


def _find_modes(samples: Array, tolerance: tuple[float, float]) -> list[int]:
    """Numbers of (n, 6) samples, the densest first, apart from the result and from each other."""
    numbers, found, last = np.arange(len(samples)), list[int](), np.zeros(6)
    while len(found) < _STARTS:
        degrees, cm = np.linalg.norm((samples[numbers] - last).reshape(-1, 2, 3), axis=2).T
        numbers = numbers[(np.degrees(degrees) > tolerance[0]) | (100 * cm > tolerance[1])]
        if not len(numbers):
            break
        found.append(int(numbers[0]))
        last = samples[numbers[0]]
    return found


def _driven_between_m(run: MatchingRun, pair: tuple[str, str]) -> float:
    """How far the vehicle drives between the images of two cameras, the mean over frames.

    By the times of the rig or by stamps; zero if neither or no motion is known.
    """
    stated = [run.solution.solved_rig.cameras[name].time_offset_s for name in pair]
    usual_m_s, ways = _USUAL_M_S if run.correspondences.is_swept else 0.0, list[float]()
    for frame in run.dataset.frames:
        times_s = [frame.image_after_s(name) for name in pair] if None in stated else stated
        twist = frame.twist_per_s
        speed_m_s = usual_m_s if twist is None else float(np.linalg.norm(twist[3:]))
        ways.append(speed_m_s * float(np.ptp([seconds or 0.0 for seconds in times_s])))
    return float(np.mean(ways))


def _open(dataset: Datasets, rig: Rig | None, most_frames: int | None) -> tuple[FrameChoice, Rig]:
    """The frames that the matcher is given, and the initial guess."""
    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset, rig)
    guess = (rig if rig is not None else data.rig).require_cameras()
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
    at: Rig,
    table: Correspondences,
    *,
    config: Config,
    terms: Terms,
) -> Solution:
    """The joint solve; where there is too little to solve from, with a hint about the guess.

    A camera with too few correspondences is placed by what it sees in common with another; if that
    does not place it either, it is excluded, and the others are calibrated.
    """
    start = at.with_lenses_of(guess)  # the mean of their priors
    try:
        return solve_joint(start, table, config, terms)
    except CorrespondenceError as error:
        with suppress(CalibrationError, OSError):
            matches = match_cameras(dataset, guess, most_frames=PAIR_FRAMES, seed=config.seed)
            matches = with_surfaces(matches, dataset, start)
            return solve_joint(start, table, config, terms, camera_matches=matches)
        with suppress(CorrespondenceError):
            return solve_without_failing(start, table, config, terms)
        cause = likely_intended_guess(dataset, guess)
        if cause is None and error.camera in table.findings.missed:
            cause = "the search has not found this camera: give more frames, or a nearer guess"
        if cause is None:
            raise
        raise CorrespondenceError(f"{error}; {cause}", camera=error.camera) from error

"""``check``: is the calibration that is deployed still right?"""

import logging
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.audit.judgement import (
    FALSE_ALARM_RATE,
    SEARCHES_FARTHER,
    Limits,
    Measured,
    deviation_of,
    find_lidar_motion,
    has_too_few_frames,
    judge_camera,
    tolerance_twist,
)
from calibgraph.audit.lidars import measure_lidars
from calibgraph.audit.result import Audit, CameraAudit
from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.io.calibrations import StatedResult, stated_result
from calibgraph.io.dataset import Dataset, keep_frames, load_dataset
from calibgraph.io.frame import hash_source
from calibgraph.io.rigs import load_rig
from calibgraph.matching.burnt_in import describe_burnt_in, hide_burnt_in
from calibgraph.matching.frame_choice import CANDIDATES, without_copies
from calibgraph.matching.named import find_matcher
from calibgraph.matching.protocol import FullMatcher
from calibgraph.matching.run import MatchingRun
from calibgraph.matching.same_images import require_different_images
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import pose_difference
from calibgraph.model.result_files import CALIBRATION_FILE
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Status
from calibgraph.parallel import with_own_threads
from calibgraph.progress import Progress, Stopwatch, no_progress
from calibgraph.rounds import (
    AnyMatcher,
    Datasets,
    assign_places,
    find_stationary,
    refine_with_camera_pairs,
    run_rounds,
)
from calibgraph.solver.joint import solve_without_failing
from calibgraph.solver.solution import Solution
from calibgraph.trust.agreement import competing_solution_checks, pair_agreement_checks
from calibgraph.trust.evidence import Evidence, Found, by_camera, gather_of_run
from calibgraph.trust.guess import point_distance_checks
from calibgraph.trust.image_evidence import check_images
from calibgraph.trust.inputs import describe_copies
from calibgraph.trust.lens_checks import intrinsics_checks
from calibgraph.trust.matcher_checks import last_round_checks, matcher_checks
from calibgraph.trust.solution_checks import estimate_checks, outlier_frame_checks
from calibgraph.trust.thresholds import threshold
from calibgraph.vehicle.joined import joint_covariance

_log = logging.getLogger(__name__)

DOUBTS: tuple[Callable[[Evidence], Found], ...] = (
    point_distance_checks,
    estimate_checks,
    matcher_checks,
    pair_agreement_checks,
    competing_solution_checks,
    outlier_frame_checks,
    intrinsics_checks,
)
"""Checks of the measurement; a FAIL of one makes it unusable. None compares it with its guess."""


@with_own_threads
def check(
    rig: Rig | Path | str,
    dataset: Datasets,
    *,
    tolerance_deg: float = 0.5,
    tolerance_cm: float = 10.0,
    matcher: AnyMatcher = "structure",
    seed: int = 0,
    progress: Progress | None = None,
) -> Audit:
    """Compare a deployed calibration with what images and clouds show. Nothing is replaced.

    Matching begins at the deployed extrinsics, without a search; the rig's ``relative_poses`` take
    no part, since they may be as outdated as the extrinsics. Several LiDARs are measured again in
    the base.

    Args:
        rig: the deployed calibration, of alignments. For the path of a result, the audit also has
            the result's verdict, and whether it was made from this recording; clouds are of one
            instant if the result's are (``instant_clouds``).
        dataset: a recent recording: a dataset, its folder, a KITTI odometry sequence, or several.
        tolerance_deg: largest turn of a camera that is OK.
        tolerance_cm: largest shift of a camera that is OK.
        matcher: as of :func:`calibgraph.calibrate`.
        seed: of everything random.
        progress: called as the work goes on.

    Returns:
        Per camera, and per LiDAR but the base, OK, WRONG or CANNOT TELL, the deviation per axis and
        its error bar.

    Raises:
        FileError, DatasetError: if the data cannot be read or do not fit together.
        CorrespondenceError: if a table given as matcher is wrong.
        ValueError: if a tolerance is not positive, or the matcher is unknown.
    """
    tolerance, report = tolerance_twist(tolerance_deg, tolerance_cm), progress or no_progress
    full, watch = find_matcher(matcher, seed=seed), Stopwatch()
    loaded = rig if isinstance(rig, Rig) else load_rig(rig)
    deployed = loaded.model_copy(update={"relative_poses": ()})
    given = dataset if isinstance(dataset, Dataset) else load_dataset(dataset, deployed)
    same_recording, stated = (False, None) if isinstance(rig, Rig) else provenance(rig, given)
    if stated is not None and stated.instant_clouds:
        given = given.at_instants()
    measured = list[Measured]()
    if deployed.other_lidars:
        with watch("lidars"):
            given, lidars = measure_lidars(
                deployed, given, Config(seed=seed), tolerance, matcher=matcher, progress=report
            )
            measured.append(lidars)
    with watch("choose_frames"):
        data = _open(given, deployed, full) if deployed.cameras else given
    if deployed.cameras:
        cameras = _measure_cameras(
            data, deployed, full, tolerance, config=Config(seed=seed), watch=watch, progress=report
        )
        measured.insert(0, cameras)
    middle = data.frames[len(data.frames) // 2].with_burnt_in({})  # as it was recorded
    sources = tuple(map(str, data.folders))
    return Audit(
        cameras.audits if deployed.cameras else {}, _judge_lidar(measured, tolerance), deployed,
        middle, sources, tolerance_deg, tolerance_cm, len(data.frames), watch.seconds,
        same_recording, None if stated is None else stated.status,
        lidars.audits if deployed.other_lidars else {},
    )  # fmt: skip


def _open(data: Dataset, deployed: Rig, matcher: FullMatcher) -> Dataset:
    """The frames that the matcher is given, without copies, which are logged."""
    data, most = keep_frames(data), matcher.most_frames
    require_different_images(data, deployed)
    data = keep_frames(hide_burnt_in(data, deployed))
    for line in describe_burnt_in(data):
        _log.warning(line)
    choice = without_copies(data if most is None else data.spread_out(CANDIDATES * most))
    if choice.copies:
        _log.warning(describe_copies(choice.copies))
    return choice.dataset if most is None else choice.dataset.spread_out(most)


def _measure_cameras(
    data: Dataset, deployed: Rig, matcher: FullMatcher, tolerance: Array, *, config: Config,
    watch: Stopwatch, progress: Progress,
) -> Measured:  # fmt: skip
    """The cameras by images and clouds."""
    try:
        run = match_from_deployed(data, deployed, matcher, config, watch=watch, progress=progress)
        with watch("places"):
            run = assign_places(run)
        run = refine_with_camera_pairs(run)
        with watch("checks"):
            evidence = gather_of_run(run, asks_guess=True)
            doubts = _doubts(run, evidence, progress)
            cameras = {
                name: judge_camera(evidence, name, doubts[name], tolerance)
                for name in deployed.cameras
            }
    except CorrespondenceError as error:
        too_few_matches = error.camera in deployed.cameras and error.row is None
        if not too_few_matches:  # a wrong table
            raise
        nothing = CameraAudit("CANNOT TELL", f"{error}; {SEARCHES_FARTHER}")
        return Measured(dict.fromkeys(deployed.cameras, nothing))
    finally:
        matcher.release()
    trusted = not any(doubts.values()) and all(each.sigma is not None for each in cameras.values())
    return Measured(
        cameras,
        [deviation_of(evidence, name) for name in cameras],
        evidence.joint_covariance if trusted else None,
        -evidence.solution.by_lidars,
        [*deployed.T_camera_lidar.values()],
    )


def _judge_lidar(measured: Sequence[Measured], tolerance: Array) -> CameraAudit | None:
    """The motion of the LiDAR, of several the base, if one explains the deviations of all others.

    None where none is WRONG, or with a single one, which cannot be told from the LiDAR; and where
    a measurement cannot be trusted.
    """
    known = [(of.covariance, of.by_errors) for of in measured if of.covariance is not None]
    if len(known) < len(measured):
        return None
    statuses = [audit.status for each in measured for audit in each.audits.values()]
    return find_lidar_motion(
        np.concatenate([one for each in measured for one in each.deviations]),
        known[0][0] if len(known) == 1 else joint_covariance(*known[0], *known[1]),
        [T for each in measured for T in each.poses],
        moved=[k for k, status in enumerate(statuses) if status == "WRONG"],
        quantile=Limits.of(np.inf, FALSE_ALARM_RATE / len(statuses), tolerance).axis[0],
    )


def _doubts(run: MatchingRun, evidence: Evidence, progress: Progress) -> dict[str, str]:
    """Per camera, why its measurement cannot be trusted; empty if it can."""
    parts = [*(check(evidence) for check in DOUBTS), last_round_checks(run)]
    z_scores = evidence.findings.z_score
    disagree = {name: _doubt_by_z_score(z_scores.get(name)) for name in evidence.cameras}
    open_ = [n for n, doubt in disagree.items() if not (doubt or has_too_few_frames(evidence, n))]
    of_frames = _doubts_by_frames(run, open_, progress)
    return {
        name: disagree[name]
        or "; ".join(of_frames.get(name, []) + [c.text for c in checks if c.status == "FAIL"])
        for name, checks in by_camera(evidence.cameras, *parts).items()
    }


def _doubts_by_frames(
    run: MatchingRun, cameras: Collection[str], progress: Progress
) -> dict[str, list[str]]:
    """Per camera, the frames that fit another extrinsic.

    Nothing is concluded about matchers that use other information than these scores.
    """
    if not run.matcher.image_checks_can_fail or not cameras:
        return {}
    rig = run.solution.without_pairs().solved_rig
    rig = rig.model_copy(update={"cameras": {name: rig.cameras[name] for name in cameras}})
    found = check_images(run.dataset, rig, lens=False, pairing=False, progress=progress)
    of_frames = ((name, check) for name, check in found if check.kind != "displaced_z_score")
    return {name: [check.text] for name, check in of_frames if check.status != "PASS"}


def _doubt_by_z_score(z_score: float | None) -> str:
    """The doubt where a calibration would WARN already: wrong results have such z-scores, too."""
    row = threshold("z_score")
    if z_score is None or row.grade(z_score) == "PASS":
        return ""
    return (
        f"images and clouds agree too little (z-score {z_score:.1f}, {row.warn:g} needed): "
        f"{SEARCHES_FARTHER}; else record sharp images of more structure, and check the intrinsics"
    )


def provenance(rig: Path | str, data: Dataset) -> tuple[bool, StatedResult | None]:
    """Whether a recording is the deployed result's own; what that states, None of other rigs.

    Only clouds with the name of one of its inputs are read.

    Raises:
        FileError: if the result is malformed, or of mounts; or a cloud cannot be read.
    """
    path = Path(rig) / CALIBRATION_FILE if Path(rig).is_dir() else Path(rig)
    if (result := stated_result(path)) is None:
        return False, None
    if result.of != "alignment":
        raise FileError(
            path, f"has poses of the {result.of}, and check compares alignments; give the "
            "alignment, by `calibgraph solve` of its table with --of alignment",
        )  # fmt: skip
    names = {Path(source).name for source in result.inputs}
    clouds = (frame.cloud_path for frame in data.frames if frame.cloud_path.name in names)
    same = any(hash_source(cloud) in result.inputs.values() for cloud in clouds)
    return same, result


_REACH_DEG, _REACH_CM = 0.7, 20.0
"""Errors of the start that the tracking rounds correct."""


def match_from_deployed(
    data: Dataset,
    deployed: Rig,
    matcher: FullMatcher,
    config: Config,
    *,
    watch: Stopwatch,
    progress: Progress,
) -> MatchingRun:
    """Match in the last tracking round; if cameras still move, in all of these, then in all rounds.

    Raises:
        CorrespondenceError: if no camera has enough correspondences.
    """
    tracking, places = matcher.tracking_rounds, find_stationary(data, deployed)

    def find(at: Rig, index: int) -> Correspondences:
        with watch("match"):
            table = matcher.match(data, at, round_index=index, progress=progress)
            return table.with_places(places)

    def solve(at: Rig, table: Correspondences) -> Solution:
        with watch("solve"):
            return solve_without_failing(at, table, config)

    def match(rounds: Sequence[int]) -> MatchingRun:
        *_, (table, solution, done) = run_rounds(deployed, rounds, find, solve)
        return MatchingRun(data, matcher, deployed, table, solution, done, watch, progress=progress)

    if not tracking:
        return match(range(matcher.rounds))
    if len(tracking) > 1:  # the last alone, if it ends where it begins, as a converged run
        with suppress(CorrespondenceError):
            run = match(tracking[-1:])
            if not run.solution.held and _has_settled(run, still="PASS"):
                return run
    run = match(tracking)
    return run if _has_settled(run) else match((0, *tracking))


def _has_settled(run: MatchingRun, still: Status = "WARN") -> bool:
    """Whether every camera ended within reach, with a good z-score, after a short last step."""
    z_scores, last = run.correspondences.findings.z_score, run.rounds[-1]
    deployed, ended = run.guess.T_camera_lidar, run.solution.solved_rig.T_camera_lidar
    for name, T in deployed.items():
        degrees, centimetres = pose_difference(ended[name], T)
        grades = [
            threshold("last_round_rotation").grade(last[name]["moved_deg"]),
            threshold("last_round_translation").grade(last[name]["moved_cm"]),
        ]
        is_good = threshold("z_score").grade(z_scores.get(name, 0.0)) == "PASS"
        is_near = degrees <= _REACH_DEG and centimetres <= _REACH_CM
        if not (is_good and is_near and {*grades} <= {"PASS", still}):
            return False
    return True

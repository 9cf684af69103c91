"""The whole method, read from top to bottom: ``calibrate`` and ``solve``.

``calibrate`` goes from images and clouds to a calibration, ``solve`` from a table of
correspondences. Both end in ``solver.joint.solve_joint``, which is section 3 of the paper.

Where the default path leaves the paper: the matcher ``structure`` runs in rounds, each from the
last estimate, in place of one pass of a learned matcher; with it there is no Stage 1 by PnP (its
groups of windows constrain a camera, but not a single frame), so T_hat is the estimate that a round
starts from. With ``cmrnext`` and with tables of correspondences, Stage 1 is the paper's.
"""

import logging
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.io.clouds import describe_thinned
from calibgraph.io.dataset import Dataset, load_dataset
from calibgraph.io.rigs import load_rig
from calibgraph.io.tables import load_correspondences
from calibgraph.matching.named import is_table
from calibgraph.matching.run import MatchingRun
from calibgraph.model.calibration import Calibration, Later
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.clock import odd_motions, unused_times
from calibgraph.model.config import Config, Terms, config_from
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.lens import with_sigmas
from calibgraph.model.rig import Lidar, Rig
from calibgraph.parallel import Threads, with_own_threads
from calibgraph.progress import Progress, Stopwatch, no_progress
from calibgraph.rounds import (
    AnyMatcher,
    Datasets,
    go_on_elsewhere,
    match_in_rounds,
    refine_with_camera_pairs,
)
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.assess import assess, assess_run
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.image_record import ImageRecord
from calibgraph.trust.inputs import registered_twists
from calibgraph.trust.lens_checks import asks_offset
from calibgraph.trust.probability import STRUCTURE, TABLES, judge
from calibgraph.trust.solution_checks import residuals_of, weaknesses
from calibgraph.vehicle.joined import join_clouds, joint_covariance, place_by_cameras
from calibgraph.vehicle.rig import LidarResult, calibrate_rig_lidars

_log = logging.getLogger(__name__)


@with_own_threads
def calibrate(
    dataset: Datasets,
    rig: Rig | Path | str | None = None,
    matcher: AnyMatcher = "structure",
    config: Config | Mapping[str, Any] | None = None,
    *,
    terms: Terms = "full",
    time_limit_s: float | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate all cameras of a rig jointly from images and clouds, and its LiDARs from clouds.

    Of several LiDARs each is calibrated to the base. Cameras of which the base sees too little are
    matched with the clouds of all LiDARs.

    Args:
        dataset: a dataset, its folder, a KITTI odometry sequence, or several folders of one rig.
        rig: the initial guess, or its file; the rig that lies with the data if None.
        matcher: ``structure``; a matcher of your own; or correspondences, from a file or in memory.
        config: settings of the solve, or a mapping of them; the preset ``auto`` if None.
        terms: of the objective, see :func:`calibgraph.solve`.
        time_limit_s: when to stop matching; the result is then marked as partial.
        progress: called as the work goes on.

    Returns:
        The calibration, with the correspondences of its last round.

    Raises:
        FileError, DatasetError: if the data cannot be read or do not fit together.
        CorrespondenceError: if a camera gets too few correspondences.
        ValueError: if the matcher is unknown.
    """
    rig = load_rig(rig) if isinstance(rig, (Path, str)) else rig
    config, report = _config_of(config), progress or no_progress
    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset, rig)
    rig = rig if rig and data is dataset else data.rig
    data = data.at_instants() if config.instant_clouds else data
    limits: Any = {"terms": terms, "time_limit_s": time_limit_s, "progress": report}
    watch = Stopwatch()
    if not rig.other_lidars:
        return _finish(match_in_rounds(data, rig, matcher, config, **limits))[0]
    with watch("lidars"):
        data, lidars, joined = find_lidars(data, rig, matcher, config, **limits)
    if rig.cameras:
        result, by_lidars = _finish(match_in_rounds(data, rig, matcher, config, **limits))
    else:
        with watch("hash_inputs"):
            result, by_lidars = _without_cameras(data, rig, config, terms), np.empty((0, 0))
    result = replace(result, timings_s={**watch.seconds, **result.timings_s})
    return _with_lidars(result, lidars, by_lidars, joined)


def _config_of(config: Config | Mapping[str, Any] | None) -> Config:
    return config_from(config, "config") if isinstance(config, Mapping) else config or Config()


def _finish(run: MatchingRun) -> tuple[Calibration, Array]:
    """The calibration of a run's cameras, and :attr:`Solution.by_lidars` of it."""
    with Threads(1) as beside:
        if asks_offset(run):
            beside.submit(registered_twists, run.dataset)  # which its checks wait for
        run = refine_with_camera_pairs(run)  # what cameras see in common
        with run.watch("hash_inputs"):
            run = replace(run, hashes=hash_inputs(run.dataset))
        thinned = describe_thinned(len(frame.load_cloud()) for frame in run.dataset.frames)
        run, evidence = go_on_elsewhere(run)  # where the rounds ended wrong
        with run.watch("checks"):
            checks, record = assess_run(run, evidence)
    for line in thinned:
        _log.warning(line)
    run.progress("done", 1, 1)
    table = run.correspondences
    result = replace(
        to_calibration(evidence, checks),
        correspondences=table.with_metadata({**table.metadata, **record}),
        frames=tuple(frame.entry() for frame in run.dataset.frames),
        rounds=run.rounds,
        warnings=(*run.warnings, *thinned),
        inputs=dict(run.hashes),
        timings_s=run.watch.seconds,
    )
    return result, run.solution.by_lidars


def find_lidars(
    data: Dataset, rig: Rig, matcher: AnyMatcher, config: Config, *, terms: Terms = "full",
    time_limit_s: float | None = None, progress: Progress,
) -> tuple[Dataset, LidarResult, str]:  # fmt: skip
    """The LiDARs of a rig; the dataset, their clouds joined where cameras gain, and why in a line.

    Arguments as of :func:`calibrate`. Those that share too little are placed by its cameras.
    """
    has_clouds = bool(rig.cameras) and not is_table(matcher)
    alone = partial(
        calibrate, matcher=matcher, config=config, terms=terms, time_limit_s=time_limit_s,
        progress=progress,
    )  # fmt: skip
    place = partial(place_by_cameras, alone, data, rig) if has_clouds else None
    lidars, joined = calibrate_rig_lidars(data, rig, config, place=place, progress=progress), ""
    if has_clouds:
        data, joined = join_clouds(data, rig, lidars.poses, config.tolerance)
    if joined:
        _log.info(joined)
    return data, lidars, joined


def _without_cameras(data: Dataset, rig: Rig, config: Config, terms: Terms) -> Calibration:
    """The result of a rig without cameras, before its LiDARs."""
    return Calibration(
        rig=rig, initial_rig=rig, covariance={}, joint_covariance=np.empty((0, 0)),
        camera_verdicts={}, residuals={}, counts={}, timings_s={}, terms=terms, config=config,
        inputs=hash_inputs(data), frames=tuple(frame.entry() for frame in data.frames),
    )  # fmt: skip


def _with_lidars(
    result: Calibration, found: LidarResult, by_lidars: Array, joined: str
) -> Calibration:
    """The result with the LiDARs beside the cameras, and in one covariance with them."""
    cameras, joint = result.joint_covariance, None
    if cameras is not None:
        joint = joint_covariance(cameras, by_lidars, found.poses.joint_covariance, found.poses.root)
    T, bars = found.poses.T_base_lidar, found.poses.covariance
    lidars = {
        name: Lidar(T_base_lidar=T[name], covariance=bars[name]) if name in bars else Lidar()
        for name in result.rig.lidars or {}
    }
    return replace(
        result,
        rig=result.rig.model_copy(update={"lidars": lidars, "vehicle": found.vehicle}),
        joint_covariance=joint,
        lidar_verdicts=dict(found.verdicts),
        warnings=(*result.warnings, *found.warnings, *filter(None, [joined])),
    )


@with_own_threads
def solve(
    rig: Rig | Path | str,
    table: Correspondences | Path | str,
    config: Config | Mapping[str, Any] | None = None,
    terms: Terms = "full",
    *,
    camera_matches: CameraMatches | None = None,
) -> Calibration:
    """Calibrate all cameras of a rig jointly from correspondences.

    Args:
        rig: cameras with their initial guess, and independently known relative poses; or its file.
        table: correspondences, their points in the LiDAR frame; or their file.
        config: settings, or a mapping of them; the preset ``auto`` if None.
        terms: ``full``; ``reprojection`` (lambda = mu = 0); ``priors`` (no reprojection term);
            ``stage1`` (the aggregated per-frame PnP). The rig's ``relative_poses`` are
            measurements and take part in all but ``stage1``.
        camera_matches: what cameras see in common, with the LiDAR's surfaces.

    Returns:
        The calibration, with its verdict and the preprocessed correspondences. Of a table that
        ``calibrate`` left, the verdict counts what the images said then, if it is of this pose.

    Raises:
        FileError: if the file cannot be read, or holds wrong values.
        CorrespondenceError: if a camera cannot be determined: fewer than 6 usable correspondences
            and neither a relative pose nor common features that tie it to a camera that has more.
        ValueError: if ``terms`` is unknown.
    """
    table = table if isinstance(table, Correspondences) else load_correspondences(table)
    rig, config = load_rig(rig) if isinstance(rig, (Path, str)) else rig, _config_of(config)
    solution = solve_joint(rig, table, config, terms, camera_matches=camera_matches)
    record = ImageRecord.from_metadata(solution.correspondences.metadata)
    watch = Stopwatch()
    with watch("checks"):
        excluded, posteriors = solution.config.excluded_cameras, record.posteriors_of(solution)
        evidence = Evidence(solution, rig, posteriors, excluded)
        checks, unseen = record.join(evidence, assess(evidence))
    result = to_calibration(evidence, checks, unseen)
    motion = solution.correspondences
    unused = unused_times(rig, is_known=motion.twist_per_s is not None)
    warnings = (*unused, *odd_motions(motion))
    return replace(result, warnings=warnings, timings_s={**result.timings_s, **watch.seconds})


def to_calibration(evidence: Evidence, checks: Checks, unseen: Collection[str] = ()) -> Calibration:
    """A solution with its error bar, and its verdict by all checks.

    ``unseen`` are cameras whose images were not looked at.
    """
    solution, cameras = evidence.solution, evidence.cameras
    tolerance, matcher = solution.config.tolerance, solution.correspondences.matcher
    model = STRUCTURE if matcher == STRUCTURE else TABLES
    models = dict.fromkeys(cameras, model) | dict.fromkeys(unseen, TABLES)
    verdicts = {
        name: judge(checks[name], evidence.probability_beyond(name), tolerance, models[name])
        for name in cameras
    }
    result = Calibration(
        rig=with_sigmas(solution.solved_rig, solution.lens),
        initial_rig=evidence.guess,
        covariance={name: evidence.covariance_of(name) for name in cameras},
        joint_covariance=evidence.joint_covariance,
        pair_covariance=Later(evidence.pair_covariances),
        camera_verdicts=verdicts,
        residuals=Later(lambda: residuals_of(solution)),
        counts={name: dict(counts) for name, counts in solution.counts.items()},
        timings_s=dict(solution.timings_s),
        terms=solution.terms,
        config=solution.config,
        stage1_T_camera_lidar=solution.T_hat,
        weaknesses=Later(
            lambda: {n: weaknesses(solution, n, evidence.covariance_by_matches(n)) for n in cameras}
        ),
        error_sources=Later(lambda: evidence.error_sources),
        lens=solution.lens,
        lens_covariance=_with_poses(solution.lens_covariance, evidence),
        places=solution.correspondences.places.of_frames(solution.correspondences.frame),
        correspondences=solution.correspondences,
        camera_matches=solution.camera_matches,
        build_graph=solution.graph,
    )
    if _log.isEnabledFor(logging.INFO):
        verdict = result.verdict
        _log.info("%s %s", verdict.status, "; ".join(verdict.reasons))
    return result


def _with_poses(lens_covariance: dict[str, Array], evidence: Evidence) -> dict[str, Array]:
    """The pose's part is the reported one: what widens that is not correlated with the lens."""
    for name, joint in lens_covariance.items():
        if (own := evidence.covariance_of(name)) is not None:
            joint[:6, :6] = own
    return lens_covariance


def hash_inputs(dataset: Dataset) -> dict[str, str]:
    """SHA-256 of every cloud and image, by path."""
    return {path: digest for frame in dataset.frames for path, digest in frame.hashes().items()}

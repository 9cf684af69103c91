"""The method: section 3 of the paper in one function, :func:`solve_joint`."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibgraph.errors import CorrespondenceError
from calibgraph.graph.lens import lens_variables
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.clock import require_motion
from calibgraph.model.config import TERMS, Config, Terms
from calibgraph.model.correspondences import MAX_COORDINATE, Correspondences
from calibgraph.model.places import Places
from calibgraph.model.rig import Rig
from calibgraph.progress import Stopwatch
from calibgraph.solver.covariance import FittedObjective
from calibgraph.solver.error_model import refine_with_error_model
from calibgraph.solver.frame_weights import weigh_all_frames
from calibgraph.solver.lens import Lenses, moved_lenses, put_into
from calibgraph.solver.matches import CameraBlock, camera_blocks
from calibgraph.solver.pair_refinement import refine_with_pairs
from calibgraph.solver.pairs import PairTerm, tying_pairs
from calibgraph.solver.preprocess import Preprocessed, preprocess
from calibgraph.solver.solution import Solution
from calibgraph.solver.stage1 import Stage1, T_hat, estimate_stage1
from calibgraph.solver.two_pass import (
    USING_CORRESPONDENCES,
    Objective,
    Transforms,
    best_start,
    require_determined,
    require_known,
)

_MOST_ROUNDS = 8  # of solves, each from the lenses of the last
_SETTLED = 0.1  # standard deviations: a smaller change of a lens ends the rounds


# fmt: off
def solve_joint(
    rig: Rig,
    table: Correspondences,
    config: Config | None = None,
    terms: Terms = "full",
    *,
    pairwise: Stage1 | None = None,
    camera_matches: CameraMatches | None = None,
    lenses: Lenses | None = None,
) -> Solution:
    """The paper's method, from correspondences to the optimum.

    The margin names the paper's sections. Whether the solution can be trusted is computed
    elsewhere, in ``calibgraph.trust``.

    Args:
        rig: cameras with their initial guess, and measured relative poses.
        table: correspondences.
        config: settings; the preset ``auto`` if None.
        terms: which terms of Eq. 5 are used.
        pairwise: Stage-1 estimates of the same correspondences, to skip their PnP.
        camera_matches: what cameras see in common, with surfaces; from the correspondences' frames.
        lenses: whose values the rig's lenses have; None: those that ``config.estimate`` names, at
            the rig's lenses, and then in rounds.

    Raises:
        CorrespondenceError, ValueError: as of :func:`calibgraph.solve`.
    """
    config, watch = config or Config(), Stopwatch()
    _require_valid(rig, config, terms, camera_matches)
    if lenses is None and config.estimate:
        return _solve_with_lenses(rig, table, config, terms, camera_matches=camera_matches)

    with watch("preprocess"):                                              # Correspondence
        kept = preprocess(rig, table, config)                              # Preprocessing
        if config.stage1 is None:
            config = config.model_copy(update={"stage1": kept.table.findings.stage1})
        tied = tying_pairs(camera_matches) if terms in USING_CORRESPONDENCES else []
        held = require_determined(rig, kept.counts, tied, config.excluded_cameras)
    with watch("stage1"):
        blocks = camera_blocks(rig, kept.table, config)                    # weights w_ik
        pairwise = pairwise or estimate_stage1(rig, blocks, config)        # Stage 1: T_hat
        start = best_start(rig, blocks, pairwise, config, terms=terms, tied=tied)     # x_0
    with watch("weights"):                                                 # ours: frame weights
        weighed = weigh_all_frames(kept.table, blocks, pairwise, start, config=config, terms=terms)
        blocks, densest, outlier_frames = weighed
    objective = Objective(                                                 # Eq. 5
        rig, blocks, T_hat(pairwise), config, terms, lenses=lenses or {})
    with watch("pass1"):                                                   # Two-Pass Solver
        rough, scales = objective.minimize_with_scale(start | densest)     # 1. fit
    with watch("pass2"):
        inliers = objective.without_outliers(rough, scales)                # 2. gate tau
        optimum = inliers.minimize(rough, scales)                          # 3. fit again
    with watch("error_model"):                                             # ours: shared errors
        errors, optimum = refine_with_error_model(
            FittedObjective(inliers, scales, optimum.T_camera_lidar, held),
            optimum, kept.table.findings, kept.table.places)

    require_in_reach(optimum.T_camera_lidar)
    counts = count_correspondences(
        kept, objective, inliers, pairwise, outlier_frames=outlier_frames)
    found = Solution(
        rig, kept.table, objective, inliers, scales, optimum, counts, watch.seconds,
        held=held, errors=errors)
    return found if camera_matches is None else add_camera_pairs(found, camera_matches)
# fmt: on


def _require_valid(
    rig: Rig, config: Config, terms: Terms, camera_matches: CameraMatches | None
) -> None:
    if terms not in TERMS:
        raise ValueError(f"unknown terms {terms!r}; known are {', '.join(TERMS)}")
    require_known(rig.require_cameras(), config.excluded_cameras)
    _require_same_cameras(rig, camera_matches)


def _require_same_cameras(rig: Rig, matches: CameraMatches | None) -> None:
    of = set() if matches is None else {name for pair in matches.pairs() for name in pair}
    if unknown := sorted(of - rig.cameras.keys()):
        raise CorrespondenceError(
            f"camera matches of {', '.join(unknown)}: the rig has no such camera, but "
            f"{', '.join(rig.cameras)}; take the matches of the same result"
        )


def require_in_reach(T_camera_lidar: Transforms) -> None:
    """Refuse extrinsics that no rig file holds: nonsense has its minimum anywhere.

    Raises:
        CorrespondenceError: if a camera is farther away than a coordinate may be.
    """
    for name, T in T_camera_lidar.items():
        if not (away_m := np.abs(T[:3, 3]).max()) <= MAX_COORDINATE:
            raise CorrespondenceError(
                f"camera {name!r}: its correspondences place it {away_m:.2g} m away: they "
                "determine no extrinsic; check which pixels and points belong together",
                camera=name,
            )


def _solve_with_lenses(
    rig: Rig,
    table: Correspondences,
    config: Config,
    terms: Terms,
    *,
    camera_matches: CameraMatches | None,
) -> Solution:
    """The joint solve with the lenses that are to be estimated, in rounds until they stand.

    The lens decides which matches are inliers, and their weights; its prior stays where it is.
    """
    if config.preset != "auto" or terms not in USING_CORRESPONDENCES:
        raise ValueError(
            "lenses are estimated with the preset auto and the terms full or reprojection; found "
            f"preset {config.preset}, terms {terms}"
        )
    lenses: Lenses = lens_variables(rig, config.estimate)
    for _ in range(_MOST_ROUNDS):
        solution = solve_joint(
            put_into(rig, lenses),
            table,
            config,
            terms,
            camera_matches=camera_matches,
            lenses=lenses,
        )
        is_known = solution.correspondences.twist_per_s is not None
        require_motion(config.estimate, is_known=is_known)
        lenses, change = moved_lenses(lenses, solution.errors)
        if change < _SETTLED:
            return solution
    return replace(solution, optimum=replace(solution.optimum, converged=False))


def solve_without_failing(
    rig: Rig, table: Correspondences, config: Config, terms: Terms = "full"
) -> Solution:
    """The joint solve; cameras whose correspondences determine no pose become excluded ones.

    Raises:
        CorrespondenceError: if that is so of all cameras.
    """
    while True:
        try:
            return solve_joint(rig, table, config, terms)
        except CorrespondenceError as error:
            excluded = config.excluded_cameras
            if error.camera not in rig.cameras or error.camera in excluded:
                raise
            config = config.changed(excluded_cameras=(*excluded, error.camera))


def add_camera_pairs(solution: Solution, matches: CameraMatches) -> Solution:
    """Refine a solution with what its cameras see in common, which is no part of the paper.

    Args:
        solution: what it has used of other camera matches is left out.
        matches: with surfaces, taken near the solution; from the correspondences' frames.

    Returns:
        The same optimum where no pair of cameras has enough in common.
    """
    alone, watch = replace(solution.without_pairs(), camera_matches=matches), Stopwatch()
    with watch("camera_pairs"):
        refined = refine_with_pairs(alone.fitted, alone.pair_terms, alone.pairs_alone)
        inliers, optimum = refined or (alone.inliers, alone.optimum)
    with watch("error_model"):
        at = FittedObjective(inliers, alone.scales, optimum.T_camera_lidar, alone.held)
        table = solution.correspondences
        errors, optimum = refine_with_error_model(at, optimum, table.findings, table.places)
    return replace(
        alone,
        inliers=inliers,
        optimum=optimum,
        counts=count_common_features(alone.counts, inliers.pairs),
        timings_s={**solution.timings_s, **watch.seconds},
        errors=errors,
        alone=alone if inliers.pairs else None,
    )


def count_common_features(
    counts: Mapping[str, Mapping[str, int]], pairs: Sequence[PairTerm]
) -> dict[str, dict[str, int]]:
    """The counts, with the features of each camera that is part of a pair."""
    features = Counter[str]()
    for pair in pairs:
        features.update({name: len(pair.frame) for name in (pair.a, pair.b)})
    return {
        name: {**own, "common_features": features[name]} if name in features else dict(own)
        for name, own in counts.items()
    }


def count_correspondences(
    kept: Preprocessed,
    objective: Objective,
    inliers: Objective,
    pairwise: Stage1,
    *,
    outlier_frames: Mapping[str, int],
) -> dict[str, dict[str, int]]:
    """Per camera: correspondences left after each filter and the gate, and its frames.

    Frames that repeat another one are counted apart, and in none of the other numbers.
    """
    counts = {}
    for name, before in kept.counts.items():
        given, used = (part.blocks.get(name) for part in (objective, inliers))
        outliers = outlier_frames.get(name, 0)
        counts[name] = {
            **before,
            "used": 0 if used is None else len(used),
            "frames": (0 if given is None else given.frames) + outliers,
            "outlier_frames": outliers,
            "repeated_frames": kept.repeated_frames[name],
            "frames_used": 0 if used is None else used.frames,
            "frames_without_pnp": pairwise[name].failed_frames if name in pairwise else 0,
            **count_places(kept.table.places, used),
        }
    return counts


def count_places(places: Places, used: CameraBlock | None) -> dict[str, int]:
    """The count of the places that a camera's correspondences are from, if places are named."""
    if places.places is None:
        return {}
    return {"places": 0 if used is None else len(places.split(used.frame_numbers))}

"""Every threshold that decides PASS, WARN or FAIL, in one table, which the documentation has, too.

Limits are in units of the error that a user would suffer, and are the same for every rig. To add a
check: a row here, a function that looks the row up by its key, and that function's name in
``trust.assess``.
"""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

from calibgraph.matching.structure.acceptance import FALSE_ACCEPTANCE
from calibgraph.model.verdict import FAIL_ABOVE, PASS_BELOW, TOLERANCE, Threshold
from calibgraph.solver.covariance import ENOUGH_FRAMES

LENS_WRONG, LENS_WRONG_SHARE = 20.0, 0.01
"""The error of a wrong lens parameter, in standard deviations of a calibrated one: 0.2 % of the
focal length and of fx / fy, 0.002 focal lengths of the principal point, 0.002 of k1, 5 ms of the
time of an image, or as the rig states; and the share of those that are wrong."""
_BEYOND = [NormalDist().inv_cdf(1 - PASS_BELOW / share / 2) for share in (LENS_WRONG_SHARE, 1)]

# A value at the first limit is PASS, at the second WARN. Limits without a comment are those of a
# row above, or were chosen on the set tune of benchmarks/accuracy/verdicts.py and counted on its
# set count.
# fmt: off
THRESHOLDS: tuple[Threshold, ...] = (
    # the guess
    # Farther, and beyond sqrt(3) times the matcher's range, the guess follows another convention.
    Threshold("guess_translation", "distance from the guess", 2.0, math.inf, "m",
              "How far is the result from the guess?",
              "is T_camera_lidar inverted, or of other axes?"),
    # Likelihood ratios of 72 and 460 for a swap. Of 20,000 drawn guesses each of cameras 54 cm
    # apart, within 2 to 20 deg and 0.2 to 1.5 m, up to 0.7 % are under 0.7 and 0.15 % under 0.6;
    # with swapped images 100 and 99 % of those within 2 deg, 0.2 m, and 90 and 78 % within 5 deg,
    # 0.3 m.
    Threshold("swapped_cameras",
              "distance of two cameras to each other's guess over that to their own",
              0.7, 0.6, "", "Are the images of two cameras swapped?",
              "are their images swapped, or their extrinsics in the rig?"),
    # LiDARs do not measure farther.
    Threshold("point_distance", "median distance of the points", 200.0, 1000.0, "m",
              "Can the points be in metres?", "are the clouds in millimetres?"),
    # the estimate
    # 0.15 deg displaces a point at 20 m by 5 cm.
    Threshold("sigma_rotation", "sigma, rotation", 0.15, 0.5, "deg",
              "How large is the standard deviation about the worst axis? Of a batch it decides "
              "nothing by itself: the probability of an error has it.", of_tolerance=True),
    Threshold("sigma_translation", "sigma, translation", 5.0, 15.0, "cm",
              "The same, along the worst axis.", of_tolerance=True),
    # Sigmas of the measurement and the estimate together.
    Threshold("relative_pose", "relative pose", 4.0, 8.0, "sigma",
              "Does a measured relative pose agree with the correspondences?",
              "is it p_a = T_a_b * p_b, are its sigmas right, are two cameras' images swapped?"),
    # KITTI 00, 05, 08: right 0.2 to 0.6; a camera moved by 0.5 deg 2.0 to 3.4; a focal length 3 %
    # off 2.8 to 3.8. Four is 0.5 deg or 11 cm.
    Threshold("pair_agreement", "relative pose of two cameras by images", 1.75, 4.0,
              "sigma", "Do the images of two cameras place them relative to each other as the "
              "correspondences do?", "one of the two is wrong: check their intrinsics and the "
              "guesses, that their images are of one instant and not swapped, and that the clouds "
              "are corrected for the motion during a scan"),
    # Poses near a result are within 3 sigma of the matches; a larger ratio is of poses elsewhere.
    # The wider sigma is the error bar, so that the check changes no verdict.
    Threshold("flat_evidence", "sigma by the images over that by the matches", 3.0,
              math.inf, "times", "Do the images leave the pose more open than the matches do?",
              "the error bar is that by the images"),
    # Fewer leave little to check six numbers by.
    Threshold("correspondences_used", "correspondences used", 50, 0, "",
              "Are there enough correspondences?"),
    # With fewer, the error bar is mostly a prior.
    Threshold("frames", "frames", ENOUGH_FRAMES, 0, "", "Are there enough frames?",
              "the error bar is mostly a default, not measured"),
    # LiDARs. Right poses have 0.976 and more (two vehicles, three places), wrong ones 0.58 to 0.96.
    Threshold("lidar_matched", "planes that lie on another LiDAR's", 0.95, 0.8,
              "share", "Do the planes that LiDARs have in common coincide?",
              "check the guess T_base_lidar, and that the clouds of an instant are of one time"),
    # Of a prior of 0.1 deg and 1.5 cm.
    Threshold("lidar_places", "deviation between places over its prior", 2.0, 4.0,
              "times", "Do places give the same poses of LiDARs?",
              "were the clouds of an instant taken at different times, or has a LiDAR moved?"),
    # With fewer, what places differ by is mostly a prior.
    Threshold("lidar_instants", "instants", 3, 0, "",
              "Are there enough instants?", "the error bar is mostly a default, not measured"),
    # the matcher
    # A choice; no data recorded.
    Threshold("start_dependence", "start dependence", 0.25, 0.5, "share",
              "How much of a displaced start does a learned matcher leave?",
              "the network does not measure here"),
    # A choice; no data recorded.
    Threshold("memorization", "memorization", 0.3, 0.6, "share",
              "How much of a displaced start does a learned matcher undo without the image?",
              "the network reproduces the rig it was trained on, and pulls towards it"),
    # A choice; no data recorded.
    Threshold("failed_frames", "failed frames", 0.3, 0.7, "share",
              "How many frames gave no matches?"),
    # Recorded data: wrong results (over 0.3 deg) up to 13, right ones from 9.
    Threshold("z_score", "z-score of image and cloud", 15.0, 8.0, "",
              "Do images and clouds agree better than by chance?", "image and cloud hardly agree "
              "better than by chance; check the guess (p_camera = T_camera_lidar * p_lidar: its "
              "direction, axes and units), the intrinsics, and that images and clouds belong "
              "together"),
    # The search accepts no more; the verdict's own cut. In place of `z_score`, unless the rounds
    # end at a pose as by chance.
    Threshold("chance", "probability that a search finds as much by chance",
              FALSE_ACCEPTANCE, FAIL_ABOVE, "share",
              "Do images and clouds of one to three frames agree better than by chance?"),
    # the frames
    Threshold("competing_solution", "matches of a competing solution over those of this one",
              0.25, 0.5, "share",
              "Do the matches that were left out agree on another extrinsic, farther away than "
              "the tolerance?"),
    Threshold("outlier_frames", "share of outlier frames", 0.35, 0.9, "share",
              "How many frames lie far from where frames are densest?",
              "a minority of the frames decides; check what differs between them"),
    # Of Gaussian errors of six numbers 1 in 3000 is farther; 426 places of rendered streets and of
    # KITTI are under 3.5.
    Threshold("place_distance", "distance of a place from the others", 5.0, math.inf,
              "sigma", "Does each place agree with the others, of three and more?",
              "it counts little; look at its frames"),
    # At a place whose cloud is turned by 1 deg it is 0.05.
    Threshold("place_inliers", "inlier share of a place over that of the others", 0.5,
              0.0, "", "Does each place have as many inliers as the others?",
              "its matches are left out; look at its frames"),
    # A choice; no data recorded.
    Threshold("repeated_frames", "share of frames that repeat another one", 0.5,
              math.inf, "share", "How many frames are of the same place, or of the same content?",
              "the vehicle stood, a camera or the LiDAR was stuck, or frames are copies: they "
              "count as one frame each; take frames while it drives"),
    # the lens, from the residuals and the images
    # By the posterior of a free lens or clock, once from the residuals and once from the images,
    # and by ``LENS_WRONG``. What is under the first limit is no reason: right lenses reach it.
    Threshold("lens", "probability of a wrong one", FAIL_ABOVE, 0.8, "share",
              "Is focal length, principal point, distortion, fx / fy or time of the images wrong, "
              "so that the camera is off by more than the tolerance?", "check the intrinsics, the "
              "image size, and that images are not undistorted twice, cropped or scaled"),
    # By ``LENS_WRONG`` and its share, 0.5 % of all parameters err by more than the first limit,
    # and 0.5 % of the wrong ones by more than the second.
    Threshold("lens_prior", "distance from the rig", LENS_WRONG * _BEYOND[0],
              LENS_WRONG * _BEYOND[1], "prior sigmas",
              "How far did an estimated parameter of lens or clock move from what the rig states?",
              "correct the rig, or state how well it is known"),
    # the rounds of matching
    Threshold("last_round_rotation", "change in the last round of matching", 0.1, 0.4,
              "deg", "Have the rounds of matching converged?", of_tolerance=True),
    Threshold("last_round_translation", "change in the last round of matching", 4.0,
              12.0, "cm", "The same.", of_tolerance=True),
    Threshold("rematch_rotation", "difference after matching again", 0.15, 0.5, "deg",
              "Does matching from a displaced start end at the same result?",
              "the images do not determine the extrinsic", of_tolerance=True),
    Threshold("rematch_translation", "difference after matching again", 5.0, 15.0, "cm",
              "The same.", "the images do not determine the extrinsic", of_tolerance=True),
    # the images
    # KITTI 01, KITTI 00 and the sample: right 4.9 and more, wrong ones from a start too far away up
    # to 3.8, mostly below 2.5; mispaired images up to 5.1. A 16-beam LiDAR at one place: 2.9 at 0.4
    # deg.
    Threshold("displaced_z_score", "z-score against displaced extrinsics", 4.0, 2.5, "",
              "Does the result explain the images better than displaced extrinsics do?",
              "extrinsics a degree or 40 cm away explain the images nearly as well; check the "
              "guess, or record where there is more structure"),
    # A camera that turns halfway, by 1 to 3 deg: 0.2 to 0.55 of 18; at rest 0.8 and more of 60, on
    # grass (KITTI 10) 0.4. No value fails: the others' pose may be right.
    Threshold("frames_best", "share of the frames that fit the result best", 0.75, -1.0,
              "share", "Do the images of most frames fit the result better than displaced "
              "extrinsics?", "has the camera or the LiDAR moved during the recording, or do their "
              "images and clouds not belong together?"),
    # KITTI 00: own clouds +0.4 and more, clouds one frame off -0.4 and less; about zero where the
    # vehicle stands, which is no fault.
    Threshold("own_clouds", "score with the own clouds above that with neighbouring ones",
              -0.05, -0.2, "share", "Do images and clouds belong together?"),
    # while driving
    # Above half, most new measurements contradict the estimate.
    Threshold("disagreeing_frames", "share of the last frames that disagree with the estimate",
              0.5, 1.0, "share", "Do recent frames agree with the tracked estimate?"),
)
# fmt: on


# Numbers that decide whether a check counts, or that something is compared with.

LENS_Z_SCORE, LENS_FRAMES_BEST = 3.0, 0.5
"""Above this z-score against displaced extrinsics alone the lens is checked by the images: at a
wrong extrinsic it cannot be measured. KITTI 00, the sample: wrong lenses left 3.2 and more. And the
share of the frames whose score is highest at the result: at this and less the lens is not checked,
since images and clouds are mispaired."""
GUESS_TURNED_DEG = 30.0
"""A result that is turned farther from its guess, and beyond sqrt(3) times the matcher's range, is
compared with its convention errors."""
SWAP_SLACK = 0.05
"""Added [m, rad] in quadrature to the distances of swapped cameras: the usual error of a result is
no evidence of a swap."""
CONVENTION_DEG, CONVENTION_M = 30.0, 2.5
"""A convention error explains a guess if, undone, it is nearer to the result than both."""
CONVENTION_GAIN = 1.3
"""It explains a failed guess if the z-score exceeds the guess's by this factor, and chance."""

_ROWS = {row.key: row for row in THRESHOLDS}


@lru_cache
def threshold(key: str, tolerance: tuple[float, float] = TOLERANCE) -> Threshold:
    """The row of a key, with the limits for a tolerance [deg, cm]."""
    return _ROWS[key].at(tolerance)

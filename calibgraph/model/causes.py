"""The likely cause of each kind of check and the action to take: one table for all outputs.

A check without its own action takes the action of its cause. Causes stand in the order in which
they explain each other: a wrong guess makes matches wrong, and not the other way round.
"""

from collections.abc import Mapping
from typing import NamedTuple


class Cause(NamedTuple):
    """A cause that several checks may notice: what to do, and by kind of check what else."""

    action: str
    kinds: Mapping[str, str]


_SWAPPED = "Check whether the images of two cameras, or their extrinsics in the rig, are swapped."
_FROM_RESULT = "Calibrate again with this result as the guess: the matcher then searches around it."
_STRUCTURE = "Record where image and cloud both have structure: edges, poles, facades at 5 to 40 m."
_FRAMES = "Look at the frames that disagree: leave out those in which a sensor moved or lagged."
_SPREAD = "Give more matches, spread over the image and over distances."
_LEARNED = "Use the matcher structure."

_ESTIMATED_AS = {"focal_length": "focal", "distortion": "distortion", "principal_point": "centre"}

# fmt: off
CAUSES: dict[str, Cause] = {
    "brightness": Cause(
        "Record by daylight, or with another exposure.",
        {"brightness of the images": ""},
    ),
    "repeats": Cause(
        "See why the named images or clouds repeat, and leave the repeats out.",
        {"equal files": "", "copies": "Leave the copies out.",
         "repeated_frames": "Take frames while the vehicle drives.",
         "stuck": "See why the same points come again: a LiDAR that stands, too, measures others."},
    ),
    "guess": Cause(
        "Correct the guess: T_camera_lidar maps LiDAR points to x right, y down, z ahead, in "
        "metres.",
        {
            "convention of the guess": "Undo the named mistake, and "
            "calibrate again.",
            "guess_translation": "",
            "swapped_cameras": _SWAPPED,
            "point_distance": "Give the clouds in metres.",
            "search": "Correct the guess, or calibrate with a wider search (--search-deg up to 45, "
            "--search-m up to 5); see with doctor whether images and clouds of this camera belong "
            "together.",
        },
    ),
    "search": Cause(
        "Record at least 5 frames, 10 s apart; if the camera is not found in them either, correct "
        "the guess, and see with doctor whether images and clouds belong together.",
        {"search_in_few_frames": ""},
    ),
    "time": Cause(
        "Pair each image with the cloud of its own instant: correct the time stamps or the offset.",
        {"own_clouds": "",
         **dict.fromkeys(("time_offset", "lens_time_offset"), "Correct the time stamps, or "
                         "estimate the time of the images: --estimate offset."),
         "time_prior": "Check that the stamps of images and clouds, and the motion, are right. "
         "Then correct the named time in the rig, or state its sigma."},
    ),
    "lens": Cause(
        "Check the intrinsics: focal lengths, distortion, its model and the image size must "
        "belong to these images.",
        {
            "lens": "",
            **{f"{by}{name}": "Check that intrinsics and image size belong to these images, or "
               f"estimate the lens: --estimate {part}."
               for by in ("lens_", "") for name, part in _ESTIMATED_AS.items()},
            "lens_aspect_ratio": "", "aspect_ratio": "",
            "lens_prior": "Check that the lens belongs to these images; then correct the named "
            "value in the rig, or state intrinsics_sigma_px and distortion_sigma.",
        },
    ),
    "cameras": Cause(
        "Check the intrinsics and guesses of both cameras, and that their images are of one "
        "instant and not swapped.",
        {"pair_agreement": "",
         "contradiction": "Look whether both images have a text, a logo or a part of the vehicle "
         "at the same pixels, and record without it; else check both lenses and guesses.",
         "one_pose": "Look whether both cameras have the images of one device; if they are mounted "
         "so, state it in relative_poses."},
    ),
    "lidars": Cause(
        "Check T_base_lidar of this LiDAR: p_base = T_base_lidar * p_lidar.",
        {"lidar_matched": "Check the guess of this LiDAR, and record while the vehicle stands, or "
         "with clouds of one time.",
         "lidar_places": "Record while the vehicle stands; if it stood, check the LiDAR's mount."},
    ),
    "priors": Cause(
        "Check relative_poses and priors in the rig: p_a = T_a_b * p_b, and their sigmas.",
        {"relative_pose": ""},
    ),
    "agreement": Cause(
        _STRUCTURE,
        {"z_score": "Check the guess, the intrinsics, and that images and clouds belong together.",
         "chance": "",
         "displaced_z_score": "", "rematch_rotation": "",
         "rematch_translation": "", "matching again": "", "last_round_rotation": _FROM_RESULT,
         "last_round_translation": _FROM_RESULT},
    ),
    "matches": Cause(
        "Look at the residuals of the matches in the report: too many are wrong.",
        {"competing_solution": "", "failed_frames": "",
         "start_dependence": _LEARNED, "memorization": _LEARNED},
    ),
    "frames": Cause(
        _FRAMES,
        {"outlier_frames": "", "place_distance": "", "place_inliers": "",
         "frames_best": "Look at the frames that are named, and leave them out if something moved.",
         "disagreeing_frames": "Check whether the camera was moved.",
         "drift": "Check whether the camera's mount is loose."},
    ),
    "solver": Cause(
        _SPREAD,
        {"convergence": "", "terms": "Solve with the terms full: they have an error bar.",
         "time limit": "Raise --time-limit-s, or take fewer --frames."},
    ),
    "data": Cause(
        "Record more frames.",
        {"correspondences": "Check that this camera's images are sharp and show what the LiDAR "
         "measures.",
         "excluded": "To calibrate it by its own matches, take it out of excluded_cameras.",
         "correspondences_used": "Give at least 50 matches.",
         "frames": "Record at least 5 frames, 10 s apart.",
         "lidar_instants": "Record at least 3 instants at different places.",
         "lidar_loose": "Record where surfaces of three directions are in view of both LiDARs: "
         "ground, and walls along and across the road.",
         "lidar_start": "Write a guess of T_base_lidar into rig.yaml, within 30 deg and 2 m, or "
         "record where the surroundings look different from both ends.",
         "image evidence": _STRUCTURE,
         "images": "Calibrate again from images and clouds.",
         "common_error": "State the error that all frames share (0 if none): common_deg and "
         "common_cm in --config (of solve: --common-deg, --common-cm), or systematic_rotation_rad "
         "and systematic_translation_m in the metadata of the table.",
         "start": "Keep driving: the camera starts after enough frames with matches.",
         "blind frames": "Check that the camera delivers images and sees what the LiDAR sees."},
    ),
    "error bar": Cause(
        "",
        {"free": "Give correspondences over the whole image, and at several distances.",
         "no_error_bar": "Mend the camera whose pose is free, or leave it out.",
         "sigma_rotation": "", "sigma_translation": "", "flat_evidence": "", "went_on": _STRUCTURE},
    ),
    "other": Cause("", {}),  # of another version
}
# fmt: on

_CAUSE_OF = {kind: key for key, cause in CAUSES.items() for kind in cause.kinds}


def cause_of(kind: str) -> str:
    """The key of the cause that a kind of check notices; "other" for one of another version."""
    return _CAUSE_OF.get(kind, "other")


def action_of(kind: str) -> str:
    """The action if a check of this kind is not PASS; empty where it depends on the data."""
    cause = CAUSES[cause_of(kind)]
    return cause.kinds.get(kind) or cause.action

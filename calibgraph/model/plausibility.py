"""Values of a rig that cannot be right, or seldom are: units, an image of another size, a lens."""

from collections.abc import Iterator

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera, Rig
from factors import unproject

MAX_DISTANCE_M = 20.0
"""Between a camera and its LiDAR, or two cameras: longer than a lorry."""
_LENGTHS = "lengths in millimetres or centimetres?"
_FOCAL_SHARE = 0.1, 20.0
"""Pixels per radian over the image's longer side: below, even a pinhole sees over 157 deg and the
image circle of a fisheye covers less than a tenth of the image; above, the image shows 3 deg."""
_ASPECT = 2.2
"""Ratio of focal lengths: above anamorphic lenses and half frames of video, which have 2."""
_CENTRE_SHARE, _CENTRE_SHARE_OF_BOTH = 0.35, 0.12
"""Offset of the principal point over the image's size, along either axis and along both. A crop at
one edge, as of the sky, and a rectified pair offset it along one; few lenses are off by 0.05."""
_COVERED_DEG = 75.0
"""Fisheye lenses that see farther than this from the axis have images that are circles."""
_DISTORTED = 0.4, 3.0
"""Field angle at the image's border over that without distortion; 0.8 to 2 for normal lenses."""


def find_implausible(rig: Rig) -> list[str]:
    """The values of a rig that are impossible or rare, a line each; empty for normal rigs.

    Every line names the camera, the numbers, and the likely mistake as a question.
    """
    lines = [
        f"{name}: {text}"
        for name, camera in rig.cameras.items()
        for text in (*_extrinsic(camera.T_camera_lidar), *_intrinsics(camera))
    ]
    for pair in rig.relative_poses:
        distance = float(np.linalg.norm(pair.T_a_b[:3, 3]))
        if distance > MAX_DISTANCE_M:
            lines.append(f"{pair.b} is {distance:.0f} m from {pair.a}: {_LENGTHS}")
    return lines


def _extrinsic(T_camera_lidar: Array) -> Iterator[str]:
    distance = float(np.linalg.norm(T_camera_lidar[:3, 3]))
    if distance > MAX_DISTANCE_M:
        yield f"the camera is {distance:.0f} m from the LiDAR: {_LENGTHS}"
    if np.array_equal(T_camera_lidar, np.eye(4)):
        yield "T_camera_lidar is the identity: the camera would look along LiDAR z; not filled in?"


def _intrinsics(camera: Camera) -> Iterator[str]:
    """Sentences about focal lengths and principal point; if these are normal, on distortion."""
    k, size = camera.intrinsics_px, (camera.width_px, camera.height_px)
    image = f"a {size[0]}x{size[1]} px image"
    low, high = _FOCAL_SHARE
    if max(k.fx, k.fy) > _ASPECT * min(k.fx, k.fy):
        yield f"focal lengths {k.fx:.4g} and {k.fy:.4g} px: most cameras have square pixels"
    elif not low < camera.lens.pixels_per_rad / max(size) < high:
        mistake = "millimetres?" if camera.lens.pixels_per_rad < max(size) else "of another image?"
        yield f"focal length {k.fx:.4g} px of {image}: {mistake}"
    else:
        offset = np.abs([k.cx / size[0], k.cy / size[1]] - np.array(0.5))
        if max(offset) > _CENTRE_SHARE or min(offset) > _CENTRE_SHARE_OF_BOTH:
            yield (
                f"principal point ({k.cx:.4g}, {k.cy:.4g}) of {image}: a camera_info of another "
                "size, window or binning?"
            )
        elif any(camera.distortion):
            yield from _distortion(camera)


def _distortion(camera: Camera) -> Iterator[str]:
    """Whether the image's border has rays, and at field angles near those without distortion."""
    mirror = camera.distortion[:1] if camera.model == "omnidirectional" else ()
    none = (*mirror, *(0.0,) * (len(camera.distortion) - len(mirror)))
    reach_deg, has_rays = _reach_deg(camera)
    plain_deg, is_plain = _reach_deg(camera.model_copy(update={"distortion": none}))
    low, high = _DISTORTED
    if not has_rays and reach_deg < _COVERED_DEG:
        found = f"reaches {reach_deg:.3g} deg from its axis, and not the whole border of the image"
    elif is_plain and not low * plain_deg < reach_deg < high * plain_deg:
        found = f"reaches {reach_deg:.3g} deg from its axis, {plain_deg:.3g} deg if undistorted"
    else:
        return
    values = ", ".join(f"{value:.4g}" for value in camera.distortion)
    yield f"the lens {found}: distortion [{values}] of another order, model or image?"


def _reach_deg(camera: Camera) -> tuple[float, bool]:
    """The largest field angle at the image's border, and whether all of the border has a ray."""
    right, bottom = camera.width_px - 1.0, camera.height_px - 1.0
    border = [(x, y) for x in (0.0, right / 2, right) for y in (0.0, bottom / 2, bottom)]
    rays, known = unproject(camera.lens, border)
    angles_deg = np.degrees(np.arccos(np.clip(rays[known, 2], -1.0, 1.0)))
    return float(angles_deg.max(initial=0.0)), bool(known.all())

"""Values of a rig that cannot be right, or seldom are: units, an image of another size, a lens."""

import math
from collections.abc import Iterator

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera, Rig

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
_COVERED_SHARE, _COVERED_DEG = 0.95, 75.0
"""Share of the image that the lens projects to; less is normal for fisheye lenses that see farther
than this from the axis, whose images are circles."""
_DISTORTED = 0.4, 3.0
"""Field angle at the image's border over that without distortion; 0.8 to 2 for normal lenses."""
_DECENTRED = 0.1
"""Shift of the image's border by p1 and p2, over its distance from the axis; below 0.02 for normal
lenses. The coefficients k3 and k4 of a fisheye lens, read as p1 and p2, shift it by more."""
_DIRECTIONS, _BISECTIONS = 96, 40  # in which a lens is examined, and how finely
_PINHOLE_LIMIT = 19.0  # of the tangent of a field angle, 87 deg


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
    """Whether the lens reaches the image's border, and at a field angle near that without."""
    covered, reach_deg = _reach(camera)
    mirror = camera.distortion[:1] if camera.model == "omnidirectional" else ()
    none = (*mirror, *(0.0,) * (len(camera.distortion) - len(mirror)))
    _, plain_deg = _reach(camera.model_copy(update={"distortion": none}))
    low, high = _DISTORTED
    if covered < _COVERED_SHARE and reach_deg < _COVERED_DEG:
        found = f"reaches {reach_deg:.3g} deg from its axis and covers {covered:.0%} of the image"
    elif not low * plain_deg < reach_deg < high * plain_deg:
        found = f"reaches {reach_deg:.3g} deg from its axis, {plain_deg:.3g} deg if undistorted"
    elif (shift := _decentring(camera, plain_deg)) > _DECENTRED:
        found = f"shifts the image's border by {shift:.0%}, by p1 and p2"
    else:
        return
    values = ", ".join(f"{value:.4g}" for value in camera.distortion)
    yield f"the lens {found}: distortion [{values}] of another order, model or image?"


def _decentring(camera: Camera, reach_deg: float) -> float:
    """The shift of the image's border by p1 and p2, over its distance from the axis."""
    first = {"pinhole": 2, "omnidirectional": 3}.get(camera.model)
    if first is None:
        return 0.0
    size = 3.0 * math.hypot(*camera.distortion[first : first + 2])
    return size * math.tan(math.radians(min(reach_deg, _COVERED_DEG)))


def _reach(camera: Camera) -> tuple[float, float]:
    """The share of the image that the lens projects to, and its largest field angle there [deg].

    By bisection in all directions from the axis, along which a lens is one-to-one up to its limit.
    """
    around = np.linspace(0.0, 2 * np.pi, _DIRECTIONS, endpoint=False)
    inside_rad, outside_rad = np.zeros(_DIRECTIONS), np.full(_DIRECTIONS, _limit_rad(camera))
    for _ in range(_BISECTIONS):
        middle_rad = (inside_rad + outside_rad) / 2
        seen = camera.in_image(_project(camera, middle_rad, around))
        inside_rad = np.where(seen, middle_rad, inside_rad)
        outside_rad = np.where(seen, outside_rad, middle_rad)
    centre = np.array([camera.intrinsics_px.cx, camera.intrinsics_px.cy])
    reached = _project(camera, inside_rad, around) - centre
    size = np.array([camera.width_px, camera.height_px])
    edges = np.where(reached > 0, size - 0.5 - centre, -0.5 - centre)
    share_of_way = (reached / edges).max(axis=1)  # to the border
    area = (reached**2).sum(axis=1)  # of a sector, up to a factor
    return float(area.sum() / (area / share_of_way**2).sum()), float(np.degrees(inside_rad.max()))


def _project(camera: Camera, angles_rad: Array, around_rad: Array) -> Array:
    """(n, 2) pixels of rays at angles from the axis, in directions around it."""
    across = np.sin(angles_rad)
    rays = np.stack([across * np.cos(around_rad), across * np.sin(around_rad), np.cos(angles_rad)])
    return camera.lens.project(rays.T)[0]


def _limit_rad(camera: Camera) -> float:
    """The field angle up to which the lens is one-to-one."""
    limit = float(camera.lens.packed[-1])
    return math.atan(min(limit, _PINHOLE_LIMIT)) if camera.model == "pinhole" else limit

"""Good data, and data that are wrong in one of many ways: the table of cases of ``verdicts``.

A kind is a function of what is good (a simulated world with its matcher, or a scene of frames) and
a generator; it returns what is calibrated, the rig with its guess, and what was drawn.
"""

import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.accuracy.scenes import (
    FEW_FRAMES,
    MOTORWAY,
    ONE_CAMERA,
    Case,
    Folders,
    Scene,
    paint_images,
    with_clouds,
    with_images,
)
from calibgraph import (
    Camera,
    Frame,
    Intrinsics,
    RelativePose,
    Rig,
    calibrate,
    concatenate,
    perturb,
    solve,
)
from calibgraph.model.geometry import invert, relative_transform, transform
from tools.scenes.spoilt_images import (
    as_image,
    blurred,
    darken,
    dazzle,
    pass_truck,
    random_sign,
    roll_shutter,
    shear,
    soil,
    wet,
)
from tools.scenes.worlds import RIGS, Problem, World

Array = np.ndarray
Rng = np.random.Generator
Drawn = dict[str, Any]
RigChange = Callable[[Rig, Rng], tuple[Rig, Drawn]]

STEREO_SIGMA_DEG, STEREO_SIGMA_M = 0.1, 0.01


def random_offset(rng: Rng, least: float, most: float) -> Array:
    """(2,) of a random size between two bounds, in a random direction."""
    size, angle = rng.uniform(least, most), rng.uniform(0, 2 * np.pi)
    return size * np.array([np.cos(angle), np.sin(angle)])


def derangement(count: int, rng: Rng) -> Array:
    """A random permutation without fixed points."""
    while True:
        order = rng.permutation(count)
        if (order != np.arange(count)).all():
            return order


def to_transform(angles_deg: Array, shift_m: Array) -> Array:
    """(4, 4) from a rotation vector [deg] and a shift [m]."""
    return transform(Rotation.from_rotvec(angles_deg, degrees=True), shift_m)


def random_transform(rng: Rng, deg: float, m: float) -> Array:
    """(4, 4) a motion of this size in random directions."""
    axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    return to_transform(deg * axis, m * way)


def compose_extrinsics(rig: Rig, T_lidar_points: Array) -> Rig:
    """The rig, T_camera_lidar T_lidar_points: points come from another LiDAR frame."""
    return rig.moved_to({name: T @ T_lidar_points for name, T in rig.T_camera_lidar.items()})


def with_stereo(rig: Rig, truth: Rig, a: str, b: str) -> Rig:
    """The rig with the true relative pose of two cameras in its file, as a stereo calibration."""
    T = truth.T_camera_lidar
    pair = RelativePose(
        a=a, b=b, T_a_b=relative_transform(T[a], T[b]),
        rotation_sigma_rad=np.radians(STEREO_SIGMA_DEG), translation_sigma_m=STEREO_SIGMA_M,
    )  # fmt: skip
    return rig.model_copy(update={"relative_poses": (pair,)})


def with_lenses(rig: Rig, change: Callable[[Camera], Drawn]) -> Rig:
    """The rig with some fields of every camera changed."""
    cameras = {n: camera.model_copy(update=change(camera)) for n, camera in rig.cameras.items()}
    return rig.model_copy(update={"cameras": cameras})


def with_intrinsics(rig: Rig, change: Callable[[Intrinsics], Drawn]) -> Rig:
    """The rig with some intrinsics of every camera changed."""
    return with_lenses(
        rig, lambda c: {"intrinsics_px": c.intrinsics_px.model_copy(update=change(c.intrinsics_px))}
    )


def scaled_lens(rig: Rig, factor: float, names: tuple[str, ...] = ("fx", "fy")) -> Rig:
    """The rig with intrinsics that are wrong by a factor."""
    return with_intrinsics(rig, lambda k: {name: factor * getattr(k, name) for name in names})


def wrong_focal(rig: Rig, rng: Rng, share: float) -> tuple[Rig, Drawn]:
    """The rig's focal lengths are wrong."""
    factor = 1 + random_sign(rng) * share
    return scaled_lens(rig, factor), {"factor": factor}


def wrong_focal_y(rig: Rig, rng: Rng) -> tuple[Rig, Drawn]:
    """The rig's fy alone is 3 to 5 % wrong."""
    factor = 1 + random_sign(rng) * rng.uniform(0.03, 0.05)
    return scaled_lens(rig, factor, ("fy",)), {"factor": factor}


def wrong_principal_point(rig: Rig, rng: Rng) -> tuple[Rig, Drawn]:
    """The rig's principal points are wrong by 15 to 40 px."""
    off = random_offset(rng, 15, 40)
    moved = with_intrinsics(rig, lambda k: {"cx": k.cx + off[0], "cy": k.cy + off[1]})
    return moved, {"offset_px": off.tolist()}


def half_resolution(rig: Rig, rng: Rng) -> tuple[Rig, Drawn]:
    """The intrinsics are those of images of half the size."""
    return scaled_lens(rig, 0.5, ("fx", "fy", "cx", "cy")), {}


def inverted(rig: Rig, rng: Rng) -> tuple[Rig, Drawn]:
    """The guess is T_lidar_camera."""
    return rig.moved_to({name: invert(T) for name, T in rig.T_camera_lidar.items()}), {}


OF_RIGS: dict[str, RigChange] = {
    "focal_5": partial(wrong_focal, share=0.05),
    "focal_3": partial(wrong_focal, share=0.03),
    "principal": wrong_principal_point,
    "inverted": inverted,
}
"""Rigs that are wrong, of tables and of scenes."""


def good(of: World | Scene, rng: Rng, change: RigChange | None = None) -> Case:
    """Good data; the rig may be wrong."""
    guess, drawn = change(of.guess(), rng) if change else (of.guess(), {})
    return of.data, guess, drawn


def random(world: World, rng: Rng) -> Case:
    """Every pixel is random."""
    errors = replace(world.errors, outlier_share=1.0, informative_confidence=False)
    return replace(world, errors=errors).table(), world.guess(), {}


def swapped_names(world: World, rng: Rng) -> Case:
    """Two neighbouring cameras' matches have each other's names; their relative pose is known."""
    names = list(world.truth.cameras)
    first = int(rng.integers(len(names) - 1))
    a, b = names[first], names[first + 1]
    table, swap = world.table(), {a: b, b: a}
    renamed = replace(table, cameras=tuple(swap.get(name, name) for name in table.cameras))
    return renamed, with_stereo(world.guess(), world.truth, a, b), {"swapped": [a, b]}


def tied(world: World, rng: Rng) -> Case:
    """One camera has no matches: a right relative pose ties it to another."""
    names = list(world.truth.cameras)
    without, other = (names[k] for k in rng.permutation(len(names))[:2])
    table = concatenate([world.table().of_camera(name) for name in names if name != without])
    return table, with_stereo(world.guess(), world.truth, without, other), {"without": without}


def shuffled_table(world: World, rng: Rng) -> Case:
    """Clouds are paired with images of other frames; the vehicle moves 1 to 2 m per frame."""
    how = str(rng.choice(["neighbours", "next", "any"]))
    order = np.arange(world.frames)
    if how == "any":
        order = derangement(world.frames, rng)
    else:
        order = order + 1 if how == "next" else np.where(order % 2 == 0, order + 1, order - 1)
    T_start_lidar = [np.eye(4)]
    for _ in range(world.frames):
        turn, ahead = np.array([0, 0, rng.uniform(-2, 2)]), np.array([rng.uniform(1, 2), 0, 0])
        T_start_lidar.append(T_start_lidar[-1] @ to_transform(turn, ahead))

    def rig_at(frame: int) -> Rig:
        T_image_cloud = invert(T_start_lidar[order[frame]]) @ T_start_lidar[frame]
        return compose_extrinsics(world.truth, T_image_cloud)

    return world.table(rig_at), world.guess(), {"shuffle": how}


def distorted(world: World, rng: Rng) -> Case:
    """The lenses distort, and the rig file has no distortion."""
    k1 = rng.uniform(-0.35, -0.25)
    lenses = with_lenses(world.truth, lambda camera: {"distortion": (k1, 0.1, 0.0, 0.0, 0.0)})
    guess = with_lenses(world.guess(), lambda camera: {"distortion": ()})
    return replace(world, truth=lenses).table(), guess, {"k1": k1}


def with_points(world: World, rng: Rng, scale: Any) -> Case:
    """The points are mirrored (y is -y), or in millimetres."""
    table = world.table()
    return replace(table, points_lidar_m=table.points_lidar_m * scale), world.guess(), {}


def wall(world: World, rng: Rng) -> Case:
    """Each camera sees one wall and nothing else, opposite or oblique."""
    distance, tilt = rng.uniform(5, 30), rng.choice([0.0, rng.uniform(10, 70)])
    angle = rng.uniform(0, 2 * np.pi)
    slope = np.tan(np.radians(tilt)) * np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([*slope, 1.0])  # normal . p = distance: met on the axis at that distance
    tables, table = [], world.table()
    for name, T in world.truth.T_camera_lidar.items():
        rows = table.of_camera(name)
        points = rows.points_lidar_m @ T[:3, :3].T + T[:3, 3]
        along = points @ normal
        met = along > 0.02 * np.linalg.norm(points, axis=1)
        on_wall = points[met] * (distance / along[met])[:, None]  # pixels are unchanged
        rows = rows.select(met)
        tables.append(replace(rows, points_lidar_m=(on_wall - T[:3, 3]) @ T[:3, :3]))
    return concatenate(tables), world.guess(), {"distance_m": distance, "tilt_deg": tilt}


def narrow_cone(world: World, rng: Rng) -> Case:
    """All matches lie in a small part of the image."""
    share, middle = rng.uniform(0.05, 0.15), rng.uniform(-0.3, 0.3, 2)
    tables, table = [], world.table()
    for name, camera in world.truth.cameras.items():
        T, rows = camera.T_camera_lidar, table.of_camera(name)
        points = rows.points_lidar_m @ T[:3, :3].T + T[:3, 3]
        bundled = points[:, 2:] * np.column_stack(
            [middle + share * points[:, :2] / points[:, 2:], np.ones(len(points))]
        )
        errors = rows.pixels_px - camera.lens.project(points)[0]
        pixels = camera.lens.project(bundled)[0] + errors
        seen = camera.in_image(pixels)  # outliers may not be
        moved = replace(rows, pixels_px=pixels, points_lidar_m=(bundled - T[:3, 3]) @ T[:3, :3])
        tables.append(moved.select(seen))
    return concatenate(tables), world.guess(), {"share": share}


def far_away(world: World, rng: Rng) -> Case:
    """All matches are beyond 40 m."""
    return replace(world, depth_m=(40.0, 120.0)).table(), world.guess(), {}


def slightly_wrong_focal(world: World, rng: Rng, of: Callable[[World, Rng], Case]) -> Case:
    """Another kind, with focal lengths wrong by 0.5 to 1 %, which weak geometry amplifies."""
    table, guess, drawn = of(world, rng)
    factor = 1 + random_sign(rng) * rng.uniform(0.005, 0.01)
    return table, scaled_lens(guess, factor), {**drawn, "factor": factor}


def two_poses(world: World, rng: Rng, share: float) -> Case:
    """A share of the matches agrees on another pose, of each camera or of the whole rig."""
    deg, m = rng.uniform(1, 10), rng.uniform(0.1, 1.0)
    whole, seed = bool(rng.random() < 0.5), int(rng.integers(2**31))
    if whole:
        other = compose_extrinsics(world.truth, random_transform(rng, deg, m))
    else:
        other = perturb(world.truth, rotation_deg=deg, translation_m=m, seed=seed)
    wrong = max(1, round(share * world.matches))
    tables = [
        replace(world, matches=max(1, world.matches - wrong)).table(),
        replace(world, truth=other, matches=wrong, seed=seed).table(),
    ]
    return concatenate(tables), world.guess(), {"deg": deg, "m": m, "whole_rig": whole}


def few_frames_of_table(world: World, rng: Rng) -> Case:
    """Two to five frames."""
    frames = int(rng.integers(2, 6))
    return replace(world, frames=frames).table(), world.guess(), {"few": frames}


def bias(world: World, rng: Rng) -> Case:
    """All frames share an error of the matcher, which no table can distinguish from a pose."""
    size, angle = rng.uniform(5, 15), rng.uniform(0, 2 * np.pi)
    table = world.table()
    pixels = table.pixels_px + size * np.array([np.cos(angle), np.sin(angle)])
    return replace(table, pixels_px=pixels), world.guess(), {"offset_px": size}


def time_offset(world: World, rng: Rng) -> Case:
    """Clouds and images are 20 to 100 ms apart, on a drive of varying speed and yaw rate."""
    seconds = random_sign(rng) * rng.uniform(0.02, 0.1)
    speed, yaw = rng.uniform(0, 15, world.frames), rng.uniform(-20, 20, world.frames)

    def rig_at(frame: int) -> Rig:
        turn, shift = np.array([0, 0, yaw[frame]]), np.array([speed[frame], 0, 0])
        return compose_extrinsics(world.truth, to_transform(seconds * turn, seconds * shift))

    return world.table(rig_at), world.guess(), {"seconds": seconds}


def lidar_axes(rig: Rig, rng: Rng) -> tuple[Rig, Drawn]:
    """The guess has cameras with the LiDAR's axes."""
    shifts = {name: T[:3, :3].T @ T[:3, 3] for name, T in rig.T_camera_lidar.items()}
    return rig.moved_to({name: transform(np.eye(3), t) for name, t in shifts.items()}), {}


TABLES: dict[str, Callable[[World, Rng], Case]] = {
    "good": good,
    "tied": tied,
    "random": random,
    "swapped": swapped_names,
    "shuffled": shuffled_table,
    **{kind: partial(good, change=change) for kind, change in OF_RIGS.items()},
    "focal_1": partial(slightly_wrong_focal, of=good),
    "distorted": distorted,
    "mirrored": partial(with_points, scale=[1, -1, 1]),
    "wall": wall,
    "narrow_cone": narrow_cone,
    "far_away": far_away,
    "wall_focal_1": partial(slightly_wrong_focal, of=wall),
    "cone_focal_1": partial(slightly_wrong_focal, of=narrow_cone),
    "far_focal_1": partial(slightly_wrong_focal, of=far_away),
    **{f"two_poses_{share}": partial(two_poses, share=share / 100) for share in (45, 60, 75)},
    "few_frames": few_frames_of_table,
    "bias": bias,
    "time_offset": time_offset,
    "units": partial(with_points, scale=1000),
    "axes": partial(good, change=lidar_axes),
}


def few_frames(scene: Scene, rng: Rng) -> Case:
    """Two to four frames of one place."""
    count = min(int(rng.integers(2, 5)), len(scene.data.frames))
    start = int(rng.integers(len(scene.data.frames) - count + 1))
    return scene.data.select(f"{start}:{start + count}"), scene.guess(), {"few": count}


def far(scene: Scene, rng: Rng, turned: bool) -> Case:
    """The guesses are beyond the matcher's range; by one displacement, that of the LiDAR."""
    deg, m = rng.uniform(6, 20), rng.uniform(0.5, 1.5)
    drawn = {"guess_deg": deg, "guess_m": m}
    if not turned:
        return scene.data, scene.guess(deg, m), drawn
    return scene.data, compose_extrinsics(scene.guess(), random_transform(rng, deg, m)), drawn


def swapped(scene: Scene, rng: Rng, known: bool = False, distant: bool = False) -> Case:
    """Images of two cameras are exchanged: of neighbours, or of the first and the last."""
    cameras = list(scene.truth.cameras)
    a, b = (cameras[0], cameras[-1]) if distant else scene.pair
    swap, guess = {a: b, b: a}, scene.guess()

    def paths(index: int, frame: Frame) -> dict[str, Path]:
        return {name: frame.image_paths[swap.get(name, name)] for name in frame.image_paths}

    guess = with_stereo(guess, scene.truth, a, b) if known else guess
    return with_images(scene.data, paths), guess, {}


def shuffled(scene: Scene, rng: Rng) -> Case:
    """Images are of other frames than the clouds."""
    frames = scene.data.frames
    order = derangement(len(frames), rng)
    data = with_images(scene.data, lambda i, frame: frames[order[i]].image_paths)
    return data, scene.guess(), {"order": order.tolist()}


def shifted(scene: Scene, rng: Rng) -> Case:
    """Images are of the next frame of the same sequence."""
    frames = scene.data.frames
    pairs = [
        replace(frame, image_paths=after.image_paths)
        for frame, after in zip(frames[:-1], frames[1:], strict=True)
        if frame.cloud_path.parent == after.cloud_path.parent
    ]
    return replace(scene.data, frames=tuple(pairs)), scene.guess(), {}


def other(scene: Scene, rng: Rng) -> Case:
    """The images are of another place."""
    images = scene.folders.images_for(scene.name).frames
    start = len(images) // 2  # also of its own images, if there is no other place
    data = with_images(scene.data, lambda i, frame: images[(i + start) % len(images)].image_paths)
    return data, scene.guess(), {}


def of_clouds(scene: Scene, rng: Rng, change: Callable[[Array], Array]) -> Case:
    """The clouds are changed."""
    return with_clouds(scene, change), scene.guess(), {}


def scaled(scene: Scene, rng: Rng) -> Case:
    """The clouds' distances are 5 % too long or too short."""
    factor = 1 + 0.05 * random_sign(rng)
    data = with_clouds(scene, lambda cloud: cloud * [factor, factor, factor, 1])
    return data, scene.guess(), {"factor": factor}


def frozen(scene: Scene, rng: Rng) -> Case:
    """One camera's images are all of one frame."""
    name = str(rng.choice(list(scene.truth.cameras)))
    first = scene.data.frames[0].image_paths[name]
    data = with_images(scene.data, lambda i, frame: {**frame.image_paths, name: first})
    return data, scene.guess(), {"changed": [name]}


def copies(scene: Scene, rng: Rng) -> Case:
    """Ten copies of one frame."""
    frame = scene.data.frames[int(rng.integers(len(scene.data.frames)))]
    frames = tuple(replace(frame, index=index) for index in range(10))
    return replace(scene.data, frames=frames), scene.guess(), {}


def painted(
    scene: Scene, rng: Rng, paint: Callable[[Array, int, Camera, Rng], Array], one: bool = True
) -> Case:
    """The images of one camera drawn at random, or of all, are changed."""
    names = list(scene.truth.cameras)
    chosen = [str(rng.choice(names))] if one else names
    data = paint_images(scene, chosen, lambda *image: paint(*image, rng))
    return data, scene.guess(), {"changed": chosen}


def moved_halfway(scene: Scene, rng: Rng) -> Case:
    """One camera turns by 1 to 3 degrees after half of the frames: by a homography."""
    half = len(scene.data.frames) // 2
    angles = random_sign(rng) * rng.uniform(1, 3) * np.eye(3)[rng.integers(3)]
    step = to_transform(angles, np.zeros(3))

    def turn(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
        if index < half:
            return image
        warp = camera.matrix_px @ step[:3, :3] @ np.linalg.inv(camera.matrix_px)
        return cv2.warpPerspective(image, warp, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT)

    return painted(scene, rng, turn)


def parked(scene: Scene, rng: Rng) -> Case:
    """Ten frames of one place: copies of one frame with fresh noise in images and clouds."""
    data, guess, _ = copies(scene, rng)

    def shake(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
        return as_image(image + rng.normal(0, 3, image.shape))

    still = replace(scene, data=data)
    still = replace(still, data=painted(still, rng, shake, one=False)[0])
    noisy = with_clouds(still, lambda c: c + rng.normal(0, [0.01, 0.01, 0.01, 0], c.shape))
    return noisy, guess, {}


def blank_wall(scene: Scene, rng: Rng) -> Case:
    """A wall without features: flat images, clouds of one plane."""

    def flatten(cloud: Array) -> Array:
        away = cloud[:, :3] / np.linalg.norm(cloud[:, :3], axis=1, keepdims=True)
        flat = cloud[np.abs(away[:, 0]) > 0.1].copy()
        flat[:, :3] *= (8 / np.abs(flat[:, 0]))[:, None]
        flat[:, 3] = 0.3
        return flat

    def grey(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
        shade = np.linspace(100, 140, image.shape[1])[None, :, None]
        return as_image(shade + rng.normal(0, 2, image.shape))

    return painted(replace(scene, data=with_clouds(scene, flatten)), rng, grey, one=False)


def covered(scene: Scene, rng: Rng, change: Callable[[Array], Array]) -> Case:
    """One camera's images are black, or blurred beyond use."""
    data, guess, drawn = painted(scene, rng, lambda image, *_: change(image))
    return data, guess, {"covered": drawn["changed"][0]}


DATA: dict[str, Callable[[Scene, Rng], Case]] = {
    "good": good,
    "motorway": good,
    "few_frames": few_frames,
    "far": partial(far, turned=False),
    "far_turned": partial(far, turned=True),
    "swapped": partial(swapped, known=True),
    "swapped_unknown": swapped,
    "shuffled": shuffled,
    "shifted": shifted,
    **{kind: partial(good, change=change) for kind, change in OF_RIGS.items()},
    "focal_y": partial(good, change=wrong_focal_y),
    "mirrored": partial(of_clouds, change=lambda cloud: cloud * [1, -1, 1, 1]),
    "other": other,
    "covered": partial(covered, change=np.zeros_like),
    "blurred": partial(covered, change=lambda image: blurred(image, 40)),
    "wrong_units": partial(of_clouds, change=lambda cloud: cloud * [1000, 1000, 1000, 1]),
    "flipped": partial(painted, paint=lambda image, *_: np.ascontiguousarray(image[:, ::-1])),
    "upside_down": partial(painted,
                           paint=lambda image, *_: np.ascontiguousarray(image[::-1, ::-1])),
    "night": partial(painted, paint=darken, one=False),
    "sun": partial(painted, paint=dazzle),
    "wet_lens": partial(painted, paint=wet),
    "dirty_lens": partial(painted, paint=soil),
    "defocused": partial(painted, paint=lambda image, *_: blurred(image, image.shape[1] / 300)),
    "rolling_shutter": partial(painted, paint=roll_shutter, one=False),
    "sheared": partial(painted, paint=shear, one=False),
    "truck": partial(painted, paint=pass_truck, one=False),
    "moved_halfway": moved_halfway,
    "frozen": frozen,
    "copies": copies,
    "parked": parked,
    "blank_wall": blank_wall,
    "exchanged_axes": partial(of_clouds, change=lambda cloud: cloud[:, [1, 0, 2, 3]]),
    "scaled": scaled,
    "half_resolution": partial(good, change=half_resolution),
    "distant_swap": partial(swapped, distant=True),
}  # fmt: skip

BETWEEN_CAMERAS = ("swapped", "swapped_unknown", "distant_swap")
BETWEEN_FRAMES = ("shuffled", "shifted", "moved_halfway", "frozen", "few_frames")
"""Kinds that need two cameras, and three frames."""
UNDETECTABLE = ("bias", "scaled")
"""No data can distinguish these from another pose: they show a limit, and are not counted."""
_RIGS_OF = {"distorted": ("pair", "wide_pair", "surround")}  # a fisheye always has coefficients


def rig_for(kind: str, seed: int) -> str:
    """The name of the rig of a table's case."""
    names = _RIGS_OF.get(kind, tuple(RIGS))
    return names[seed % len(names)]


def data_for(kind: str, names: list[str], seed: int) -> str | None:
    """The name of a case's data, or None if there is none."""
    if kind == "motorway":
        return MOTORWAY
    lacking = (ONE_CAMERA if kind in BETWEEN_CAMERAS else ()) + (
        FEW_FRAMES if kind in BETWEEN_FRAMES else ()
    )
    fit = [name for name in names if name not in lacking]
    return fit[(seed + zlib.crc32(kind.encode())) % len(fit)] if fit else None


def table_problem(kind: str, rig: str, seed: int) -> Problem:
    """One case of TABLES, of one of RIGS; all that is drawn is of the seed."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    world = World.draw(RIGS[rig], rng)
    table, guess, drawn = TABLES[kind](world, rng)
    return Problem(world.truth, lambda: solve(guess, table), {**world.drawn(), **drawn})


def data_problem(kind: str, name: str, seed: int, folders: Folders, scratch: Path) -> Problem:
    """One case of DATA; ``scratch``: an empty folder, to be removed after the case has run."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    data, truth = folders.load(name)
    scene = Scene(name, data, truth, folders, scratch, int(rng.integers(2**31)))
    spoilt, guess, drawn = DATA[kind](scene, rng)
    return Problem(truth, lambda: calibrate(spoilt, guess), {"frames": len(spoilt.frames), **drawn})

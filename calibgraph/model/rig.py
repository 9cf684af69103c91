"""The rig: one LiDAR, its cameras with lenses and extrinsics, and measured relative poses.

``T_a_b`` maps coordinates in b to coordinates in a: ``p_camera = T_camera_lidar * p_lidar``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from calibgraph.arrays import Array
from calibgraph.errors import RigError
from calibgraph.files import StrictNumbers, holds_truth_value, write_yaml
from calibgraph.model.correspondences import MAX_COORDINATE
from factors import Lens, LensModel
from factors.lens import ORDERS

RIG_FORMAT: Literal["calibgraph-rig/1"] = "calibgraph-rig/1"

MAX_PIXELS = 200_000_000
"""Of an image, 0.6 GB decoded; the largest sensors have 151 million."""

ROUNDING = 1e-3
"""Largest deviation of R^T R from the identity that counts as rounded digits, not as an error."""
_EXACT = 1e-14  # of a rotation in double precision


def rigid_transform(value: Any) -> Array:
    """Check a 4x4 rigid transform and return it with its rounding errors removed.

    Raises:
        ValueError: if it is not 4x4, finite, with last row 0 0 0 1 and a rotation.
    """
    try:
        T = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError("expected a 4x4 matrix of numbers") from error
    if T.shape != (4, 4):
        raise ValueError(f"expected a 4x4 matrix, found shape {T.shape}")
    if not np.isfinite(T).all():
        raise ValueError("the matrix holds values that are not finite")
    if np.abs(T).max() > MAX_COORDINATE:
        raise ValueError(f"the matrix holds {T.flat[np.abs(T).argmax()]:g}; lengths are in metres")
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 0:
        raise ValueError(f"the last row must be 0 0 0 1, found {T[3].tolist()}")
    deviation = np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max()
    if deviation > ROUNDING:
        raise ValueError(
            f"the upper left 3x3 is not a rotation: R^T R differs from the identity by "
            f"{deviation:.3g}; if its digits are rounded, write at least 4"
        )
    if np.linalg.det(T[:3, :3]) < 0:
        raise ValueError("the upper left 3x3 has determinant -1: it mirrors; check the axes' signs")
    if deviation > _EXACT:  # so that what has been written is read bit by bit
        u, _, vt = np.linalg.svd(T[:3, :3])
        T[:3, :3] = u @ vt
    T.setflags(write=False)
    return T


_TO_LISTS = PlainSerializer(lambda array: array.tolist(), return_type=list)
Transform = Annotated[Array, BeforeValidator(rigid_transform), _TO_LISTS]


LARGEST_VARIANCE = 1e24
"""That of a pose that nothing determines is smaller."""
_DIGITS = 1e-6  # of correlations: other programs may write fewer


def covariance_matrix(value: Any) -> Array:
    """Check a covariance: a square matrix of finite numbers, symmetric, no variance negative."""
    try:
        found = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError("expected a matrix of numbers") from error
    if holds_truth_value(value):
        raise ValueError("expected a matrix of numbers, found a truth value in it")
    is_finite = (np.abs(found) <= LARGEST_VARIANCE).all()
    if found.ndim != 2 or len({*found.shape}) != 1 or not is_finite:  # noqa: PLR2004
        raise ValueError(f"expected a square matrix of finite numbers, found {found.shape}")
    variances = np.diag(found)
    units = np.sqrt(np.where(variances > 0, variances, 1.0))
    correlations = found / np.outer(units, units)
    if not np.allclose(correlations, correlations.T, atol=_DIGITS):
        raise ValueError("it is not symmetric; if the file was edited, write it again")
    if (variances < 0).any() or np.linalg.eigvalsh(correlations)[0] < -_DIGITS * len(found):
        raise ValueError("it has negative variances; if the file was edited, write it again")
    return found


def _pose_covariance(value: Any) -> Array:
    """Check a (6, 6) covariance of a pose, all of which is known."""
    found = covariance_matrix(value)
    if found.shape != (6, 6):
        raise ValueError(f"expected a 6x6 matrix, found {found.shape}")
    units = np.sqrt(np.diag(found))
    if not units.all() or np.linalg.eigvalsh(found / np.outer(units, units))[0] <= 0:
        raise ValueError("the covariance is not positive definite")
    found.setflags(write=False)
    return found


PoseCovariance = Annotated[Array, BeforeValidator(_pose_covariance), _TO_LISTS]


LENS_NAMES: Final[Mapping[LensModel, tuple[str, ...]]] = {
    "pinhole": (
        "pinhole", "plumb_bob", "radtan", "rational_polynomial", "radial_tangential", "radial",
        "rational", "brown", "brown_conrady", "perspective", "opencv", "full_opencv", "standard",
        "pinhole_radtan", "pinhole_radtan8", "pinhole_full", "pinhole_none", "none",
    ),
    "fisheye": (
        "fisheye", "equidistant", "equi", "kannala_brandt", "opencv_fisheye", "kannala_brandt4",
        "kannala_brandt8", "kb", "kb4", "kb8", "pinhole_equi", "pinhole_equidistant",
        "pinhole_fisheye", "equidistant_fisheye", "fisheye_equidistant",
    ),
    "omnidirectional": (
        "omnidirectional", "omni", "omnidir", "mei", "unified", "omni_radtan", "omni_none",
    ),
}  # fmt: skip
"""Names of ROS, Kalibr, OpenCV, camodocal, COLMAP, Basalt, multical and others; the first is ours.
Capitals, hyphens, blanks and a `Camera` or `model` at the end do not count."""

KNOWN_LENSES: Final = "; ".join(
    f"{model} ({', '.join(names[1:6])})" for model, names in LENS_NAMES.items()
)
"""The models and their commonest names, for messages."""


def plain_key(name: str) -> str:
    """A name without capitals and punctuation."""
    return re.sub(r"[\W_]", "", name.lower())


_MODELS = {plain_key(name): model for model, names in LENS_NAMES.items() for name in names}


def find_lens_model(name: str) -> LensModel | None:
    """The model here of a name that others give it; None if there is no such model here."""
    key = plain_key(name)
    return _MODELS.get(key) or _MODELS.get(re.sub(r"(camera|model|lens)+$", "", key) or key)


def _checked_name(name: str) -> str:
    """A camera's name is part of file names and messages."""
    if not re.fullmatch(r"[^/\\]{1,100}", name) or not name.isprintable() or name in (".", ".."):
        raise ValueError(
            f"camera name {name!r}: expected 1 to 100 printable characters without slashes, "
            "and not a dot"
        )
    return name


def _require_printable(name: str) -> str:
    if not name.isprintable():
        raise ValueError(f"{name!r} holds characters that are not seen; rename it")
    return name


def _checked_model(name: Any) -> Any:
    """The name of a lens model, as it is."""
    ours = find_lens_model(name) if isinstance(name, str) and name else None
    if ours not in (None, name):
        raise ValueError(f"{name!r} is called {ours!r} here; its distortion is {ORDERS[ours]}")
    return name


CameraName = Annotated[str, AfterValidator(_checked_name)]
FrameId = Annotated[str, Field(pattern=r"^\S{1,200}$"), AfterValidator(_require_printable)]
Sigma = Annotated[float, Field(ge=1e-5, allow_inf_nan=False)]  # below, LM stalls
_OrInfinite = Annotated[float, Field(ge=1e-5)]
KnownSigma = _OrInfinite | tuple[_OrInfinite, _OrInfinite, _OrInfinite]
Size = Annotated[int, Field(gt=0, le=1_000_000, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Bounded = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=MAX_COORDINATE, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]
SecondsSigma = Annotated[float, Field(ge=1e-6, le=10)]


class _Model(StrictNumbers):
    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    @model_serializer(mode="wrap")
    def _leave_out_what_is_not_given(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in dump(self).items() if value is not None}


IMAGE_TIMES = "time_offset_s", "time_offset_sigma_s", "readout_s", "readout_sigma_s"
KNOWLEDGE = "intrinsics_sigma_px", "distortion_sigma", *IMAGE_TIMES
"""Fields of a camera on its times, and how well these and the lens are known."""

_LENS = "intrinsics_px", "distortion", "time_offset_s", "readout_s"


class Intrinsics(_Model):
    """Focal lengths and principal point [px]; pixel (0, 0) is the centre of the top-left pixel."""

    fx: Positive
    fy: Positive
    cx: Bounded
    cy: Bounded


class IntrinsicsSigma(_Model):
    """Standard deviations [px] of the focal lengths and of each coordinate of the centre."""

    focal: Positive | None = None
    centre: Positive | None = None


class Mount(_Model):
    """The transform of a robot's tree by which a camera hangs, and that its calibration changes.

    ``T_parent_lidar`` and ``T_camera_child`` are those of the tree that the calibration keeps.
    """

    parent: FrameId
    child: FrameId
    T_parent_lidar: Transform
    T_camera_child: Transform

    def T_parent_child(self, T_lidar_camera: Array) -> Array:
        """(4, 4) with which the camera is where it was measured."""
        T: Array = self.T_parent_lidar @ T_lidar_camera @ self.T_camera_child
        return T


class Camera(_Model):
    """One camera: its lens, its image size, and its extrinsic: a guess, or the reference.

    ``intrinsics_sigma_px`` and ``distortion_sigma`` (of radial coefficients) are how well the lens
    is known where it is estimated; ``calibgraph.graph.lens`` has defaults. ``frame_id`` is that of
    its optical frame in ROS, as its bag names it, and ``mount`` the link of the robot's tree by
    which it hangs. ``covariance`` is that of a reference with error bars: (6, 6) of xi = (rotation
    [rad], translation [m]) in T_camera_lidar = exp(xi) T, in the camera's axes.

    ``time_offset_s``: how long after the points of a frame the middle row is taken. ``readout_s``:
    from the first row to the last, of a rolling shutter; negative where the last row is first.
    """

    model: Annotated[LensModel, BeforeValidator(_checked_model)] = "pinhole"
    width_px: Size
    height_px: Size
    intrinsics_px: Intrinsics
    distortion: tuple[Bounded, ...] = ()
    intrinsics_sigma_px: IntrinsicsSigma | None = None
    distortion_sigma: Positive | None = None
    frame_id: FrameId | None = None
    mount: Mount | None = None
    T_camera_lidar: Transform
    covariance: PoseCovariance | None = None
    time_offset_s: Seconds | None = None
    time_offset_sigma_s: SecondsSigma | None = None
    readout_s: Seconds | None = None
    readout_sigma_s: SecondsSigma | None = None

    @model_validator(mode="after")
    def _lens_can_be_built(self) -> Self:
        if self.width_px * self.height_px > MAX_PIXELS:
            raise ValueError(
                f"{self.width_px}x{self.height_px} px are over {MAX_PIXELS:.0e} pixels"
            )
        _ = self.lens
        return self

    @cached_property
    def lens(self) -> Lens:
        """The lens model for projection."""
        k = self.intrinsics_px
        return Lens.of(self.model, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy, distortion=self.distortion)

    @property
    def matrix_px(self) -> Array:
        """(3, 3) the camera matrix K."""
        k = self.intrinsics_px
        return np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]])

    def moved_to(self, T_camera_lidar: Array) -> Camera:
        """The same camera with another (4, 4) T_camera_lidar, whose error is unknown."""
        T = rigid_transform(T_camera_lidar)
        return self.model_copy(update={"T_camera_lidar": T, "covariance": None})

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A copy with some fields changed, not checked; the lens follows the intrinsics."""
        copy = super().model_copy(update=update, deep=deep)
        if update and update.keys() - {"T_camera_lidar", "covariance", "frame_id", "mount"}:
            copy.__dict__.pop("lens", None)
        return copy

    def in_image(self, pixels_px: Array) -> NDArray[np.bool_]:
        """Which of (n, 2) pixels lie on the image."""
        u, v = pixels_px.T  # pixel (0, 0) is the centre of the top-left cell
        across = (u >= -0.5) & (u < self.width_px - 0.5)  # noqa: PLR2004
        return np.asarray(across & (v >= -0.5) & (v < self.height_px - 0.5))  # noqa: PLR2004


class RelativePose(_Model):
    """A measurement of camera b in camera a: stereo calibration, CAD, Kalibr."""

    a: str
    b: str
    T_a_b: Transform
    rotation_sigma_rad: Sigma
    translation_sigma_m: Sigma


class Lidar(_Model):
    """One of several LiDARs: its pose in the base LiDAR, a guess or a result, if it is known.

    ``covariance`` is that of a result: (6, 6) of (rotation [rad], translation [m]) in the base's
    axes, R = exp(rotation) R_estimate, t = t_estimate + translation.
    """

    T_base_lidar: Transform | None = None
    covariance: PoseCovariance | None = None


VEHICLE_AXES = ("roll", "pitch", "yaw", "x", "y", "z")


class Vehicle(_Model):
    """The vehicle's frame, and what is known of the base LiDAR in it.

    A sigma is a number or three, of x, y, z; .inf for what is unknown.
    """

    frame: FrameId = "base_link"
    T_vehicle_lidar: Transform | None = None
    rotation_sigma_rad: KnownSigma = math.inf
    translation_sigma_m: KnownSigma = math.inf

    @property
    def sigmas(self) -> Array:
        """(6,) of rotation [rad] and translation [m], in the vehicle's axes."""
        parts = self.rotation_sigma_rad, self.translation_sigma_m
        return np.concatenate([np.broadcast_to(part, 3) for part in parts])

    @property
    def unknown_axes(self) -> tuple[str, ...]:
        """Those of which nothing is known: a sigma is infinite, or there is no pose."""
        unknown = np.isinf(self.sigmas) | (self.T_vehicle_lidar is None)
        return tuple(axis for axis, is_so in zip(VEHICLE_AXES, unknown, strict=True) if is_so)


class Rig(_Model):
    """A LiDAR and its cameras, in a fixed order; other LiDARs, and the vehicle.

    ``lidar`` is the base: ``T_camera_lidar`` and ``T_base_lidar`` are of it. A rig of several
    LiDARs names them all in ``lidars`` and may have no camera.
    """

    format: Literal["calibgraph-rig/1"] = RIG_FORMAT
    lidar: str = "lidar"
    cameras: dict[CameraName, Camera] = {}
    lidars: dict[CameraName, Lidar] | None = None
    vehicle: Vehicle | None = None
    relative_poses: tuple[RelativePose, ...] = ()
    cloud_columns: tuple[str, ...] | None = None
    """Names of the float32 columns of .bin clouds, such as x, y, z, intensity, ring."""

    @model_validator(mode="after")
    def _lidars_fit(self) -> Self:
        names = [*(self.lidars or {})]
        if not self.cameras and len(names) <= 1:
            raise ValueError("cameras: the rig has none; name one, or at least two lidars")
        if names and self.lidar not in names:
            raise ValueError(
                f"lidar: the base {self.lidar!r} is none of the lidars {', '.join(names)}"
            )
        if self.vehicle is not None and len(names) <= 1:
            raise ValueError("vehicle: is found with several lidars; name them, or leave it out")
        if both := [name for name in names if name in self.cameras]:
            raise ValueError(f"lidars: {both[0]!r} is a camera, too; rename one")
        T = self.lidars[self.lidar].T_base_lidar if self.lidars else None
        if T is not None and np.abs(T - np.eye(4)).max() > ROUNDING:
            raise ValueError(
                f"lidars.{self.lidar}.T_base_lidar: of the base it is the identity; leave it out"
            )
        return self

    @model_validator(mode="after")
    def _relative_poses_name_cameras(self) -> Self:
        for index, pair in enumerate(self.relative_poses):
            for name in (pair.a, pair.b):
                if name not in self.cameras:
                    raise ValueError(
                        f"relative_poses[{index}] names camera {name!r}; the rig has "
                        f"{', '.join(self.cameras)}"
                    )
            if pair.a == pair.b:
                raise ValueError(f"relative_poses[{index}] relates camera {pair.a!r} to itself")
        return self

    @property
    def T_base_lidar(self) -> dict[str, Array]:
        """(4, 4) of each LiDAR whose pose is known, the base's identity among them."""
        known = {n: of.T_base_lidar for n, of in (self.lidars or {}).items()} | {
            self.lidar: np.eye(4)
        }
        return {name: T for name, T in known.items() if T is not None}

    @property
    def all_lidars(self) -> tuple[str, ...]:
        """Names of several LiDARs, the base first; empty if the rig names none."""
        return (self.lidar, *self.other_lidars) if self.lidars else ()

    @property
    def other_lidars(self) -> tuple[str, ...]:
        """Names of the LiDARs but the base."""
        return tuple(name for name in self.lidars or {} if name != self.lidar)

    @property
    def T_camera_lidar(self) -> dict[str, Array]:
        """Each camera's (4, 4) transform: p_camera = T_camera_lidar * p_lidar."""
        return {name: camera.T_camera_lidar for name, camera in self.cameras.items()}

    def require_cameras(self) -> Rig:
        """The rig itself.

        Raises:
            RigError: if it has no camera.
        """
        if not self.cameras:
            raise RigError(
                f"the rig has no camera, only LiDARs ({', '.join(self.lidars or {})}); these are "
                "calibrated by calibrate, read by report and written by export"
            )
        return self

    def moved_to(self, T_camera_lidar: Mapping[str, Array]) -> Rig:
        """The same rig with other T_camera_lidar, (4, 4), of some cameras or all.

        Raises:
            RigError: if a camera is not of this rig.
        """
        for name in T_camera_lidar:
            if name not in self.cameras:
                raise RigError(
                    f"camera {name!r} is not in the rig, which has "
                    f"{', '.join(map(repr, self.cameras))}",
                    camera=name,
                )
        cameras = {
            name: camera.moved_to(T_camera_lidar[name]) if name in T_camera_lidar else camera
            for name, camera in self.cameras.items()
        }
        return self.model_copy(update={"cameras": cameras})

    def with_lenses_of(self, other: Rig) -> Rig:
        """The same extrinsics with the lenses and clocks of a rig of the same cameras."""
        lenses = {n: {key: getattr(c, key) for key in _LENS} for n, c in other.cameras.items()}
        cameras = {n: camera.model_copy(update=lenses[n]) for n, camera in self.cameras.items()}
        return self if cameras == self.cameras else self.model_copy(update={"cameras": cameras})

    def save(self, path: Path | str, *, first_line: str = "") -> None:
        """Write the rig file; the first line is a comment."""
        write_yaml(Path(path), self.model_dump(), first_line=first_line)

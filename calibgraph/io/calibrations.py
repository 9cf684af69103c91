"""Results from disk: the YAML file of a calibration, and the table beside it."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, AliasPath, BaseModel, BeforeValidator, Field, StrictBool

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_yaml, sha256
from calibgraph.io.tables import load_camera_matches, load_correspondences
from calibgraph.model.calibration import Calibration, Residuals
from calibgraph.model.config import FORMER_SETTINGS, Config, Reported, Terms
from calibgraph.model.error_sources import ErrorSources
from calibgraph.model.lens import LensEstimate, joint_parameters
from calibgraph.model.result_files import (
    CALIBRATION_FILE,
    CALIBRATION_FORMAT,
    CAMERA_MATCHES_FILE,
    CORRESPONDENCES_FILE,
    is_calibration_file,
)
from calibgraph.model.rig import (
    LARGEST_VARIANCE,
    Finite,
    Rig,
    covariance_matrix,
    rigid_transform,
)
from calibgraph.model.verdict import Status, Verdict

Table = TypeVar("Table")

_POSE = 6  # numbers of one
_MEASURED = (
    "timings_s", "residuals", "rounds", "error_sources", "lens", "covariance",
    "joint_covariance", "pair_covariance", "lens_covariance", "sigmas",
)  # fmt: skip


def load_calibration(path: Path | str) -> Calibration:
    """Read a result, from its folder or its file, with the correspondences beside it.

    Raises:
        FileError: if it is missing or malformed.
    """
    path = Path(path)
    path = path / CALIBRATION_FILE if path.is_dir() else path
    content = read_yaml(path)
    if not is_calibration(content):
        raise FileError(
            path, f"has format {content.get('format')!r}, expected {CALIBRATION_FORMAT}"
        )
    _require_whole(content, path)
    for key in _MEASURED:
        _require_possible(content.get(key), f"{path}: {key}")
    parts = checked_model(_Parts, content, path)
    found = Calibration(
        lens_covariance={name: of.covariance for name, of in parts.lens_covariance.items()},
        frames=tuple(frame.model_dump(exclude_none=True) for frame in parts.frames_used),
        correspondences=_table(path, CORRESPONDENCES_FILE, content, load_correspondences),
        camera_matches=_table(path, CAMERA_MATCHES_FILE, content, load_camera_matches),
        **{name: getattr(parts, name) for name in _PLAIN},
    )
    _require_consistent(path, content, parts, found)
    return found


def _require_possible(value: Any, where: str) -> None:
    """Check that the numbers below a key are finite, and none that no measurement has."""
    if isinstance(value, (dict, list)):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            _require_possible(each, f"{where}.{key}")
    elif isinstance(value, float) and not abs(value) <= LARGEST_VARIANCE:
        raise FileError(
            where, f"is {value}, no number of a result; the file was edited, write it again"
        )


def _of_one_pose(found: Array) -> Array:
    if len(found) != _POSE:
        raise ValueError(f"expected a 6x6 matrix, found {found.shape}")
    return found


Matrix = Annotated[Any, BeforeValidator(covariance_matrix)]
Covariance = Annotated[Matrix, AfterValidator(_of_one_pose)]


class _Motion(BaseModel):
    twist_per_s: tuple[Finite, Finite, Finite, Finite, Finite, Finite]
    to_s: Finite


class _FrameEntry(BaseModel):
    frame: int
    name: str
    cloud: str
    images: dict[str, str]
    lidars: dict[str, str] | None = None
    joined: dict[str, tuple[tuple[Finite, ...], ...]] | None = None
    motion: _Motion | None = None
    cloud_columns: tuple[str, ...] | None = None


class _JointOfLens(BaseModel):
    parameters: tuple[str, ...]
    covariance: Matrix


def _without_former(settings: Any) -> Any:
    """Settings without those of earlier versions that changed nothing."""
    former = FORMER_SETTINGS.items()
    is_map = isinstance(settings, dict)
    return {k: v for k, v in settings.items() if (k, v) not in former} if is_map else settings


class _Parts(BaseModel):
    """The keys of a result's file that are read, with their types; the others repeat them."""

    rig: Rig
    initial_rig: Rig
    config: Annotated[Config, BeforeValidator(_without_former)]
    covariance: dict[str, Covariance | None]
    joint_covariance: Matrix | None
    pair_covariance: dict[str, Covariance]
    stage1_T_camera_lidar: dict[str, Annotated[Any, BeforeValidator(rigid_transform)]]
    camera_verdicts: dict[str, Verdict]
    lidar_verdicts: dict[str, Verdict] = {}
    residuals: dict[str, Residuals]
    weaknesses: dict[str, tuple[str, ...]]
    frames_used: tuple[_FrameEntry, ...]
    moves: tuple[str, ...] = ()
    motion: str = ""
    places: tuple[tuple[int, ...], ...] = ()
    rounds: tuple[dict[str, Any], ...]
    warnings: tuple[str, ...] = ()
    counts: dict[str, dict[str, int]]
    timings_s: dict[str, float]
    terms: Terms
    error_sources: dict[str, ErrorSources] = {}
    lens: dict[str, tuple[LensEstimate, ...]] = {}
    lens_covariance: dict[str, _JointOfLens] = {}
    inputs: dict[str, str]
    versions: dict[str, str]
    date: str = ""


def _require_consistent(
    path: Path, content: Mapping[str, Any], parts: _Parts, found: Calibration
) -> None:
    """Check that the verdict follows from its checks, and all parts are of the same cameras."""
    verdicts = [("the rig", content.get("verdict"), found.verdict)]
    for kind, key in (("camera", "camera_verdicts"), ("LiDAR", "lidar_verdicts")):
        of_kind = content.get(key, {}).items()
        verdicts += [(f"{kind} {name!r}", each, found.verdicts[name]) for name, each in of_kind]
    for what, written, verdict in verdicts:
        stated = written.get("status") if isinstance(written, dict) else written
        derived = verdict.status
        if stated != derived:
            raise FileError(
                path,
                f"has the verdict {stated} of {what}, its checks give {derived}: it was edited; "
                "write it again",
            )
    names, joint = set(found.rig.cameras), found.joint_covariance
    right = {part: names == {*getattr(found, part)} for part in _OF_ALL_CAMERAS}
    right |= {part: names >= {*getattr(found, part)} for part in _OF_SOME_CAMERAS}
    right["counts"] &= all("used" in of_camera for of_camera in found.counts.values())
    measured = {
        name for name, lidar in (found.rig.lidars or {}).items() if lidar.covariance is not None
    }
    right["lidar_verdicts"] = measured == {*found.lidar_verdicts}
    right["initial_rig"] = names == {*found.initial_rig.cameras}
    right["joint_covariance"] = joint is None or len(joint) == _POSE * len(found.joint_names)
    right["lens_covariance"] = all(
        [*of.parameters] == joint_parameters(found.lens.get(name, ()))
        and len(of.covariance) == len(of.parameters)
        for name, of in parts.lens_covariance.items()
    )
    for part in (part for part, is_right in right.items() if not is_right):
        raise FileError(path, f"its {part} are not of the cameras of its rig; write it again")


_OF_ALL_CAMERAS = ("covariance", "camera_verdicts", "counts")
_OF_SOME_CAMERAS = (
    "residuals", "stage1_T_camera_lidar", "weaknesses", "error_sources", "lens",
)  # fmt: skip
_PLAIN = {f.name for f in fields(Calibration)} & _Parts.model_fields.keys() - {"lens_covariance"}
"""The parts that are those of a calibration as they are."""


def _table(
    result: Path, name: str, content: Mapping[str, Any], load: Callable[[Path], Table]
) -> Table | None:
    path = result.with_name(name)
    if not path.is_file():
        return None
    found = sha256(path)
    if found != content.get(f"{path.stem}_sha256", found):
        raise FileError(
            path, f"is not the table of the {CALIBRATION_FILE} beside it; move it, or put the "
            "result's own there"
        )  # fmt: skip
    return load(path)


def is_calibration(content: Mapping[str, Any]) -> bool:
    """Whether the content of a YAML file is a result."""
    return content.get("format") == CALIBRATION_FORMAT


class StatedResult(BaseModel):
    """Keys of a result's file that are read without the rest of it."""

    inputs: dict[str, str] = {}
    correspondences_sha256: str | None = None
    covariance: dict[str, Covariance | None] = {}
    error_bar_holds: dict[str, StrictBool] = {}
    verdict: dict[str, Any] = {}
    status: Status | None = Field(None, validation_alias=AliasPath("verdict", "status"))
    of: Reported = Field("alignment", validation_alias=AliasPath("config", "of"))
    instant_clouds: bool = Field(False, validation_alias=AliasPath("config", "instant_clouds"))

    @property
    def hashes(self) -> set[str | None]:
        """SHA-256 of all that it was made from."""
        return {self.correspondences_sha256, *self.inputs.values()}

    @property
    def error_bars(self) -> dict[str, Array | None]:
        """Per camera, its (6, 6) covariance; None for one that does not hold."""
        return {
            name: covariance if self.error_bar_holds.get(name) else None
            for name, covariance in self.covariance.items()
        }


def stated_result(path: Path) -> StatedResult | None:
    """What the file of a rig states if it is a result; None if it is none."""
    return checked_model(StatedResult, read_yaml(path), path) if is_calibration_file(path) else None


def _require_whole(content: Mapping[str, Any], path: Path) -> None:
    """Refuse a result of which the last keys are missing."""
    missing = [key for key in ("rig", "versions") if key not in content]
    if missing:
        raise FileError(
            path,
            f"is a part of a result: it ends with the key {list(content)[-1]!r}, and "
            f"{' and '.join(map(repr, missing))} should follow; if it was cut off, copy it again, "
            "else calibrate again",
        )


def rig_of_calibration(content: Mapping[str, Any], path: Path) -> Rig:
    """The calibrated rig in the content of a result file, which may hold nothing else."""
    # Behind a verdict, a rig that is the last key may be cut off.
    if "rig" not in content or (list(content)[-1] == "rig" and "verdict" in content):
        _require_whole(content, path)
    return checked_model(Rig, content["rig"], path)

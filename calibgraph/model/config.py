"""Settings of the solve: typed, units in every name, unknown keys refused."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, ConfigDict, Field, ValidationError

from calibgraph.files import StrictNumbers, checked_model, describe, read_yaml
from calibgraph.model.verdict import TOLERANCE

Terms = Literal["stage1", "reprojection", "priors", "full"]
TERMS: tuple[Terms, ...] = get_args(Terms)
Stage1Source = Literal["pnp", "rig"]
PresetName = Literal["kitti", "walkley", "auto"]
Reported = Literal["alignment", "mount"]
LensPart = Literal["focal", "centre", "distortion", "offset", "readout"]

Pixels = Annotated[float, Field(ge=1e-6, le=1e6)]
Weight = Annotated[float, Field(ge=0, le=1e12)]
Cells = Annotated[int, Field(gt=0, le=1000)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]


class Tracking(StrictNumbers):
    """Settings of the recalibration while driving.

    Attributes:
        start_frames: frames with matches before a camera's first estimate.
        epoch_frames: frames that share one extrinsic; up to twice as many where they come at once.
        live_epochs: closed epochs that are kept with all their matches, for a new gate and a new
            linearization; older ones are merged into a summary of constant size.
        walk_rotation_deg: standard deviation, per axis, of the random walk that a drifting camera
            makes from one frame to the next. The model of a camera is constant until the residuals
            favour a walk: this one, a fifth of it, or five times it.
        walk_translation_m: the same of its position.
        step_frames: frames that must agree on a new extrinsic before a step is reported.
        blind_frames: frames without usable matches before a camera is reported as blind.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    start_frames: Annotated[int, Field(ge=5, le=1000)] = 5
    epoch_frames: Annotated[int, Field(ge=2, le=1000)] = 10
    live_epochs: Annotated[int, Field(ge=1, le=100)] = 8
    walk_rotation_deg: Annotated[float, Field(gt=0, le=10)] = 1e-3
    walk_translation_m: Annotated[float, Field(gt=0, le=1)] = 5e-5
    step_frames: Annotated[int, Field(ge=2, le=1000)] = 3
    blind_frames: Annotated[int, Field(ge=2, le=100_000)] = 20


def _lens_parts(value: Any) -> Any:
    """The names of parts, also with commas between them; ``lens`` and ``clock`` stand for more."""
    names = [*map(str.strip, value.split(","))] if isinstance(value, str) else value
    if not isinstance(names, list | tuple):
        return names
    whole = {"lens": ("focal", "centre", "distortion"), "clock": ("offset", "readout")}
    known = (*get_args(LensPart), *whole)
    for name in names:
        if name not in known:
            raise ValueError(f"{name!r} is no part; give one or more of {', '.join(known)}")
    return tuple(dict.fromkeys(part for name in names for part in whole.get(name, (name,))))


class Config(StrictNumbers):
    """Settings, with the paper's symbols. The defaults are the preset ``auto``.

    Attributes:
        preset: the preset these settings started from.
        prior_weight: lambda, the per-camera prior's weight.
        relative_prior_weight: mu, the relative-pose prior's weight.
        loss_scale_px: delta of Cauchy's loss. None: from the residuals' own spread, per camera.
        gate_px: tau, on the unweighted reprojection error. None: from the residuals' spread.
        confidence_min: c_min.
        confidence_weights: weigh residuals by sqrt(clip(c, 0.1, 1)), else uniformly.
        learnt_weights: weigh frames and confidences by their residuals, and leave out frames far
            from where frames are densest; only where per-camera estimates come from PnP.
        grid_columns, grid_rows: cells of the image in which only the best match is kept.
        matches_max: cap per camera and frame.
        stage1: source of the per-camera estimates T_hat: ``pnp``, one extrinsic per frame,
            aggregated; or ``rig``, the extrinsics in the rig as they are. None: as the table's
            matcher states, else ``pnp``.
        pnp_threshold_px: inlier threshold of the per-frame PnP.
        excluded_cameras: whose correspondences take no part. Such a camera is determined by
            relative poses or common features, else it stays where the rig has it and FAILs.
        tolerance_deg: rotation by which a result may be off: the verdict is about more.
        tolerance_cm: distance by which a camera may be off: the verdict is about more.
        common_deg, common_cm: standard deviation per camera axis of the error that all frames of a
            table share, if the table does not state it; 0 if they share none.
        of: the poses that are reported: ``alignment``, where the points, as this LiDAR delivers
            them, meet the images; or ``mount``, where the sensors are, with a wider error bar.
        estimate: parts of each lens that are estimated with the extrinsics, by ``calibrate`` and
            ``solve``: ``focal``, ``centre``, ``distortion``; ``lens`` is all three. Also
            ``offset``, how long after its cloud an image is taken, and ``readout`` of a rolling
            shutter; ``clock`` is both.
        instant_clouds: clouds count as taken at their stamp, although points have times: they are
            corrected for the motion of the vehicle already, or it stood.
        seed: of everything random.
        tracking: of the recalibration while driving.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    preset: PresetName = "auto"
    prior_weight: Weight = 1.0
    relative_prior_weight: Weight = 5.0
    loss_scale_px: Pixels | None = None
    gate_px: Pixels | None = None
    confidence_min: Annotated[float, Field(ge=0, le=1)] = 0.1
    confidence_weights: bool = False
    learnt_weights: bool = True
    grid_columns: Cells = 40
    grid_rows: Cells = 25
    matches_max: Annotated[int, Field(gt=0)] = 10_000
    stage1: Stage1Source | None = None
    pnp_threshold_px: Pixels = 8.0
    excluded_cameras: tuple[str, ...] = ()
    tolerance_deg: Annotated[float, Field(gt=0, le=180)] = TOLERANCE[0]
    tolerance_cm: Annotated[float, Field(gt=0, le=1e6)] = TOLERANCE[1]
    common_deg: Annotated[float, Field(ge=0, le=180)] | None = None
    common_cm: Annotated[float, Field(ge=0, le=10_000)] | None = None
    of: Reported = "alignment"
    estimate: Annotated[tuple[LensPart, ...], BeforeValidator(_lens_parts)] = ()
    instant_clouds: bool = False
    seed: Seed = 0
    tracking: Tracking = Tracking()

    @property
    def tolerance(self) -> tuple[float, float]:
        """Rotation [deg] and distance [cm] by which a result may be off."""
        return self.tolerance_deg, self.tolerance_cm

    def changed(self, **settings: Any) -> Config:
        """A checked copy with some settings changed.

        Raises:
            ValueError: on an unknown setting or a wrong value, in one line.
        """
        try:
            return Config.model_validate({**self.model_dump(), **settings})
        except ValidationError as error:
            raise ValueError(describe(error)) from error


_PRESETS: dict[str, dict[str, Any]] = {
    "auto": {},
    # The paper's "Implementation details": its two datasets.
    "kitti": {
        "prior_weight": 1.0,
        "relative_prior_weight": 5.0,
        "loss_scale_px": 4.0,
        "gate_px": 3.0,
        "confidence_min": 0.1,
        "learnt_weights": False,
    },
    "walkley": {
        "prior_weight": 2.0,
        "relative_prior_weight": 10.0,
        "loss_scale_px": 8.0,
        "gate_px": 16.0,
        "confidence_min": 0.2,
        "confidence_weights": True,
        "learnt_weights": False,
    },
}
FORMER_SETTINGS = {"loss": "cauchy", "bootstrap": 0}
"""Those of results of earlier versions with the values that are the only ones now."""
PRESETS: tuple[PresetName, ...] = get_args(PresetName)


def preset(name: str) -> Config:
    """The settings of a preset.

    Raises:
        ValueError: if there is no such preset.
    """
    if name not in _PRESETS:
        raise ValueError(f"unknown preset {name!r}; known are {', '.join(PRESETS)}")
    return Config(preset=name, **_PRESETS[name])  # type: ignore[arg-type]


def load_config(path: Path | str) -> Config:
    """Read settings from YAML; a ``preset`` in the file gives the values the file leaves out.

    Raises:
        FileError: if the file is missing, has an unknown key or a wrong value.
    """
    return config_from(read_yaml(Path(path)), path)


def config_from(content: Mapping[str, Any], path: Path | str) -> Config:
    """The settings in a mapping; its ``preset`` gives the values that it leaves out.

    Raises:
        FileError: if it has an unknown key or a wrong value.
    """
    name = content.get("preset", "auto")
    return checked_model(Config, {**_PRESETS.get(str(name), {}), **content}, path)

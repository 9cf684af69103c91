"""What the page gets: the session, the estimate and the advice, as plain values."""

from pydantic import BaseModel

from calibgraph.model.geometry import degrees_and_centimetres, pose_difference
from calibgraph.service.pick.advice import Advice
from calibgraph.service.pick.estimate import CameraEstimate, PickEstimate
from calibgraph.service.pick.joint import JointSolve
from calibgraph.service.pick.session import Pair
from calibgraph.service.pick.workspace import Workspace


class CameraAnswer(BaseModel):
    """A camera's name and image size."""

    name: str
    width_px: int
    height_px: int


class FrameAnswer(BaseModel):
    """A frame, and the cameras that have an image of it."""

    index: int
    name: str
    cameras: list[str]


class SessionAnswer(BaseModel):
    """The session, without its history."""

    cameras: list[CameraAnswer]
    frames: list[FrameAnswer]
    revision: int
    pairs: list[Pair]
    can_undo: bool
    can_redo: bool


class SolverAnswer(BaseModel):
    """A PnP solver's extrinsic: its error, and its distance from the joint solve."""

    solver: str
    median_px: float
    rotation_deg: float
    distance_cm: float


class PairAnswer(BaseModel):
    """A pair's residual and influence; ``place`` is its place in the session."""

    place: int
    residual_px: tuple[float, float]
    moves_deg: float | None
    moves_cm: float | None
    suspicious: bool


class CameraEstimateAnswer(BaseModel):
    """What the pairs of a camera give."""

    camera: str
    pairs_used: int
    T_camera_lidar: list[list[float]] | None
    sigma_deg: list[float] | None
    sigma_cm: list[float] | None
    rms_px: float | None
    spread_deg: float | None
    spread_cm: float | None
    solvers: list[SolverAnswer]
    pairs: list[PairAnswer]
    warnings: list[str]
    weakest: str


class AdviceAnswer(BaseModel):
    """Where to pick next: words, and the third of the image."""

    words: str
    column: int
    row: int


class EstimateAnswer(BaseModel):
    """What all pairs give."""

    revision: int
    scale: float | None
    cameras: list[CameraEstimateAnswer]
    advice: AdviceAnswer | None


class CornerAnswer(BaseModel):
    """A corner; none if ``pixel_px`` is null."""

    pixel_px: tuple[float, float] | None


class WrittenAnswer(BaseModel):
    """Names of the files in the session's folder, and the cameras of the reference."""

    files: list[str]
    cameras: list[str]


def session_answer(workspace: Workspace) -> SessionAnswer:
    """The session as it is now."""
    session, data = workspace.session, workspace.dataset
    return SessionAnswer(
        cameras=[
            CameraAnswer(name=name, width_px=camera.width_px, height_px=camera.height_px)
            for name, camera in data.rig.cameras.items()
        ],
        frames=[
            FrameAnswer(index=frame.index, name=frame.name, cameras=list(frame.image_paths))
            for frame in data.frames
        ],
        revision=session.revision,
        pairs=list(session.pairs),
        can_undo=bool(session.past),
        can_redo=bool(session.future),
    )


def estimate_answer(revision: int, estimate: PickEstimate, advice: Advice | None) -> EstimateAnswer:
    """What the pairs determine."""
    solve = estimate.solve
    return EstimateAnswer(
        revision=revision,
        scale=None if solve is None else solve.scale,
        cameras=[_camera_answer(name, one, solve) for name, one in estimate.cameras.items()],
        advice=None if advice is None else AdviceAnswer(**vars(advice)),
    )


def _camera_answer(
    name: str, estimate: CameraEstimate, solve: JointSolve | None
) -> CameraEstimateAnswer:
    solved = solve if solve is not None and name in solve.rig.cameras else None
    covariance = None if solved is None else solved.covariance_of(name)
    sigmas = None if covariance is None else degrees_and_centimetres(covariance)
    residuals = [value for one in estimate.influences for value in one.residual_px]
    mean_square = sum(value**2 for value in residuals) / max(len(estimate.influences), 1)
    return CameraEstimateAnswer(
        camera=name,
        pairs_used=len(estimate.pairs),
        T_camera_lidar=None if solved is None else solved.rig.T_camera_lidar[name].tolist(),
        sigma_deg=None if sigmas is None else sigmas[0].tolist(),
        sigma_cm=None if sigmas is None else sigmas[1].tolist(),
        rms_px=mean_square**0.5 if residuals else None,
        spread_deg=None if estimate.spread is None else estimate.spread[0],
        spread_cm=None if estimate.spread is None else estimate.spread[1],
        solvers=[] if solved is None else _solver_answers(name, estimate, solved),
        pairs=_pair_answers(estimate),
        warnings=list(estimate.warnings),
        weakest=estimate.weakest,
    )


def _solver_answers(name: str, estimate: CameraEstimate, solve: JointSolve) -> list[SolverAnswer]:
    T = solve.rig.T_camera_lidar[name]
    found = []
    for pose in estimate.solvers:
        turn, shift = pose_difference(pose.T_camera_lidar, T)
        found.append(SolverAnswer(**vars(pose), rotation_deg=turn, distance_cm=shift))
    return found


def _pair_answers(estimate: CameraEstimate) -> list[PairAnswer]:
    together = zip(estimate.pairs, estimate.influences, strict=False)  # none without an estimate
    return [PairAnswer(place=place, **vars(one)) for (place, _), one in together]

"""A Rerun recording (.rrd) of a result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.errors import needs_extra
from calibgraph.files import cannot_write, write_atomically
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress, no_progress
from calibgraph.view.scene import Projected, ViewFrame, read_frames, state_verdict

if TYPE_CHECKING:
    import rerun

_AXIS_M = 0.3
_DOT_PX = 1.5


def write_rerun(result: Calibration, path: Path | str, *, progress: Progress = no_progress) -> Path:
    """Write clouds, images and projected points of a result's frames, over the timeline ``frame``.

    Entities: ``lidar`` (the cloud, in its own frame), ``lidar/before/CAMERA`` and
    ``lidar/after/CAMERA`` (poses of the optical frames), ``images/CAMERA`` with ``before`` and
    ``after`` below it (points coloured by distance), ``verdict``.

    Raises:
        CalibrationError: if rerun-sdk is missing, or an image or cloud cannot be read.
        OSError: if the file cannot be written.
    """
    rr = _import_rerun()
    path = Path(path)

    def write(temporary: Path) -> None:
        recording = rr.RecordingStream("calibgraph", recording_id=path.stem)
        recording.save(str(temporary))
        try:
            _log_result(rr, recording, result, progress)
            recording.flush()
        except RuntimeError as error:  # of its thread that writes
            raise cannot_write(path, error) from error
        finally:
            recording.disconnect()

    write_atomically(path, write)
    return path


def _import_rerun() -> Any:
    with needs_extra("view", "--rerun needs rerun-sdk"):
        import rerun
    return rerun


def _log_result(
    rr: Any, recording: rerun.RecordingStream, result: Calibration, progress: Progress
) -> None:
    recording.set_log_time_enabled(False)  # when this was written says nothing
    recording.log("lidar", rr.ViewCoordinates.FLU, static=True)
    recording.log("verdict", rr.TextDocument(state_verdict(result)), static=True)
    for when, rig in (("before", result.initial_rig), ("after", result.rig)):
        _log_poses(rr, recording, f"lidar/{when}", rig)
    for done, frame in enumerate(read_frames(result)):
        progress(f"frame {frame.name}", done, len(result.frames))
        recording.set_time("frame", sequence=frame.number)
        _log_frame(rr, recording, frame)


def _log_poses(rr: Any, recording: rerun.RecordingStream, parent: str, rig: Rig) -> None:
    for name, T_camera_lidar in rig.T_camera_lidar.items():
        T = invert(T_camera_lidar)
        pose = rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
        entity = f"{parent}/{rr.escape_entity_path_part(name)}"
        recording.log(entity, pose, rr.TransformAxes3D(_AXIS_M), static=True)


def _log_frame(rr: Any, recording: rerun.RecordingStream, frame: ViewFrame) -> None:
    recording.log("lidar", rr.Points3D(frame.points_lidar_m, colors=frame.colours))
    for name, image in frame.images.items():
        entity = f"images/{rr.escape_entity_path_part(name)}"
        recording.log(entity, rr.EncodedImage(contents=image.jpeg, media_type="image/jpeg"))
        recording.log(f"{entity}/before", _points(rr, image.before))
        recording.log(f"{entity}/after", _points(rr, image.after))


def _points(rr: Any, points: Projected) -> Any:
    """Rerun's pixel (0, 0) is the corner of the first one."""
    return rr.Points2D(points.pixels_px + 0.5, colors=points.colours, radii=_DOT_PX)

"""A Rerun recording (.rrd) of a result."""

from pathlib import Path

from calibgraph.errors import needs_extra
from calibgraph.files import cannot_write, write_atomically
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import invert
from calibgraph.progress import Progress, no_progress
from calibgraph.view.scene import read_frames, state_verdict

with needs_extra("view", "--rerun needs rerun-sdk"):
    import rerun as rr

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
    path = Path(path)

    def write(temporary: Path) -> None:
        recording = rr.RecordingStream("calibgraph", recording_id=path.stem)
        recording.save(str(temporary))
        try:
            _log_result(recording, result, progress)
            recording.flush()
        except RuntimeError as error:  # of its thread that writes
            raise cannot_write(path, error) from error
        finally:
            recording.disconnect()

    write_atomically(path, write)
    return path


def _log_result(recording: rr.RecordingStream, result: Calibration, progress: Progress) -> None:
    recording.set_log_time_enabled(False)  # when this was written says nothing
    recording.log("lidar", rr.ViewCoordinates.FLU, static=True)
    recording.log("verdict", rr.TextDocument(state_verdict(result)), static=True)
    for when, rig in (("before", result.initial_rig), ("after", result.rig)):
        for name, T in ((name, invert(T)) for name, T in rig.T_camera_lidar.items()):
            pose = rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
            entity = f"lidar/{when}/{rr.escape_entity_path_part(name)}"
            recording.log(entity, pose, rr.TransformAxes3D(_AXIS_M), static=True)
    for done, frame in enumerate(read_frames(result)):
        progress(f"frame {frame.name}", done, len(result.frames))
        recording.set_time("frame", sequence=frame.number)
        recording.log("lidar", rr.Points3D(frame.points_lidar_m, colors=frame.colours))
        for name, jpeg in frame.images.items():
            entity = f"images/{rr.escape_entity_path_part(name)}"
            recording.log(entity, rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
            for when, (pixels, colours) in frame.projected[name].items():
                from_corner = pixels + 0.5  # of the first pixel, as Rerun counts
                dots = rr.Points2D(from_corner, colors=colours, radii=_DOT_PX)
                recording.log(f"{entity}/{when}", dots)

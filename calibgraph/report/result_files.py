"""All files of a result in its folder: the calibration, its tables, pictures and the report."""

from pathlib import Path

from calibgraph.io.dataset import Dataset
from calibgraph.model.calibration import Calibration
from calibgraph.model.result_files import (
    CAMERA_MATCHES_FILE,
    CORRESPONDENCES_FILE,
    OVERLAYS,
    REPORT_FILE,
    outputs_of_result,
)
from calibgraph.report.html import write_report
from calibgraph.report.point_overlay import write_overlays


def write_result(
    result: Calibration, folder: Path, data: Dataset | None = None, *, with_report: bool = True
) -> list[Path]:
    """Write a result: of images with an overlay picture per camera.

    Returns:
        The files to name to the user.
    """
    stale = [output.path for output in outputs_of_result(folder) if output.is_ours]
    written = [result.save(folder)]
    if data is not None:
        middle = data.frames[len(data.frames) // 2]
        mark = "FAIL, do not use: " if result.verdict.status == "FAIL" else ""
        if result.camera_matches is not None:
            written.append(folder / CAMERA_MATCHES_FILE)
        written.insert(1, folder / CORRESPONDENCES_FILE)
        written += write_overlays(middle, result.initial_rig, result.rig, folder, mark=mark)
    if with_report:
        written.append(write_report(result, folder / REPORT_FILE))
    for path in {path for path in stale if path.match(OVERLAYS)} - {*written}:
        path.unlink()  # of a camera that this result does not have
    return written

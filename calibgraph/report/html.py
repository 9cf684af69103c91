"""The page: the template, filled with all of a result; and the files of a result in its folder."""

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calibgraph.file_sets import written_together
from calibgraph.files import write_text
from calibgraph.io.dataset import Dataset
from calibgraph.io.formats import EXPORT_FORMATS
from calibgraph.io.frame import frame_of_entry
from calibgraph.model.calibration import FRAMES_SENTENCE, TANGENT_SENTENCE, Calibration
from calibgraph.model.geometry import degrees_and_centimetres, invert
from calibgraph.model.metrics import pose_error
from calibgraph.model.places import describe_places
from calibgraph.model.result_files import (
    CALIBRATION_FILE,
    CAMERA_MATCHES_FILE,
    CORRESPONDENCES_FILE,
    REPORT_FILE,
    TABLES,
    require_own_tables,
)
from calibgraph.report.camera_section import (
    camera_diagrams,
    check_cells,
    matrix_text,
    pose_text,
    worked_point,
)
from calibgraph.report.frames import recording_name
from calibgraph.report.kit import page_template
from calibgraph.report.page_overlays import depth_scale, draw_overlays, width_on_page
from calibgraph.report.point_overlay import write_overlays
from calibgraph.report.reprojection_errors import reprojection_errors
from calibgraph.solver.camera_pairs import match_errors_px


def write_report(result: Calibration, path: Path | str) -> Path:
    """Write a result as one HTML page that needs nothing else: no network, no files beside it.

    Images and clouds are read from the files that the result names; if they cannot be read, the
    page names the cause and leaves their pictures out.

    Args:
        result: any result; without correspondences the residuals' pictures are left out.
        path: of the page.

    Returns:
        The path.

    Raises:
        CorrespondenceError: if the result's correspondences do not belong to its rig.
        FileError: if the page cannot be written.
    """
    path = Path(path)
    write_text(path, render_page(result))
    return path


def render_page(result: Calibration) -> str:
    """The page as text, its diagrams drawn into it."""
    errors, rig, guess = reprojection_errors(result), result.rig, result.initial_rig
    overlays, overlays_left_out = dict[str, tuple[str, ...]](), None
    shown = frame_of_entry(result.frames[len(result.frames) // 2]) if result.frames else None
    if shown is None:
        overlays_left_out = "the result was made from a table, which names no images"
    else:
        pairs = {name: (guess.cameras[name], camera) for name, camera in rig.cameras.items()}
        overlays, overlays_left_out = draw_overlays(shown, pairs)
    cameras = [
        {
            "name": name,
            "anchor": f"camera-{index}",
            "verdict": result.camera_verdicts[name],
            "moved": pose_error(camera.T_camera_lidar, guess.T_camera_lidar[name]),
            "sigmas": result.error_bar(name),
            "overlays": overlays.get(name),
            "diagrams": camera_diagrams(result, name, errors.get(name)),
            "worked": worked_point(camera, errors.get(name)),
        }
        for index, (name, camera) in enumerate(rig.cameras.items())
    ]
    summary = result.summary
    return page_template("calibgraph.report").render(
        result=result,
        cameras=cameras,
        summary=summary,
        recording=recording_name(result),
        places=describe_places(result.places) if result.places else "",
        actions=summary.actions or ("Deploy it: see below.",),
        export_command=_export_command(result),
        export_formats=EXPORT_FORMATS,
        pairs={name: result.error_bar(name) for name in result.pair_covariance},
        between=_camera_pairs(result),
        check_cells=check_cells,
        matrix_text=matrix_text,
        pose_text=pose_text,
        invert=invert,
        degrees_and_centimetres=degrees_and_centimetres,
        width_on_page=width_on_page,
        depth_scale=depth_scale(),
        shown=shown,
        overlays_left_out=overlays_left_out,
        residuals_left_out=not errors,
        config=yaml.safe_dump(result.config.model_dump(), sort_keys=False, allow_unicode=True),
        frames_sentence=FRAMES_SENTENCE,
        tangent_sentence=TANGENT_SENTENCE,
    )


def _camera_pairs(result: Calibration) -> list[dict[str, Any]]:
    """What each pair of cameras sees in common, in the rig's order, with the check of it."""
    table, rows = result.camera_matches, list[dict[str, Any]]()
    if table is None:
        return rows
    for a, b in table.pairs():
        matches = table.of_pair(a, b)
        errors_px = match_errors_px(result.rig, matches)
        known, name = errors_px[~np.isnan(errors_px)], f"relative pose of {a} and {b} by images"
        rows.append({
            "name": f"{a}, {b}", "matches": len(matches), "surfaces": len(known),
            "frames": len(np.unique(matches.frame)),
            "median_px": f"{np.median(known):.2f}" if len(known) else "-",
            "check": next((c for c in result.camera_verdicts[a].checks if c.name == name), None),
        })  # fmt: skip
    return rows


def _export_command(result: Calibration) -> str:
    """The command that exports the cameras that did not FAIL; empty if there are none."""
    usable = [n for n in result.rig.cameras if result.camera_verdicts[n].status != "FAIL"]
    if not usable:
        return ""
    words = ["calibgraph", "export", ".", "--format", "ros2-launch", "--out", "rig.launch.xml"]
    if len(usable) < len(result.rig.cameras):
        words += [word for name in usable for word in ("--camera", name)]
    return shlex.join(words)


def write_result(
    result: Calibration,
    folder: Path,
    data: Dataset | None = None,
    *,
    with_report: bool = True,
) -> list[Path]:
    """Write a result in place of an older one: of images with an overlay picture per camera.

    After an error none of them appears, and the calibration is the last.

    Returns:
        The files to name to the user.
    """
    require_own_tables(folder)
    with written_together(folder, last=CALIBRATION_FILE) as new:
        written = [result.save(new)]
        tables = (new / CORRESPONDENCES_FILE, new / CAMERA_MATCHES_FILE)
        written += [table for table in tables if table.exists()]
        if data is not None:
            middle = data.frames[len(data.frames) // 2]
            verdicts = {name: one.status for name, one in result.camera_verdicts.items()}
            written += write_overlays(
                middle, result.initial_rig, result.rig, new, verdicts=verdicts
            )
        if with_report:
            write_text(new / REPORT_FILE, render_page(result))
            written.append(new / REPORT_FILE)
        names = {path.name for path in new.iterdir()}
    for name in set(TABLES) - names:
        (folder / name).unlink(missing_ok=True)  # of the result that this one replaces
    return [folder / path.name for path in written]

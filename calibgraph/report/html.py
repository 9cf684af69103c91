"""The page: the template, filled with all of a result; and the files of a result in its folder."""

import os
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.files import write_text, written_together
from calibgraph.io.formats import EXPORT_FORMATS
from calibgraph.io.frame import Frame, frame_of_entry
from calibgraph.model.calibration import FRAMES_SENTENCE, TANGENT_SENTENCE, Calibration
from calibgraph.model.geometry import invert
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
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Check, beside, in_unit, is_reachable
from calibgraph.report.kit import page_template
from calibgraph.report.pictures import (
    depth_scale,
    draw_lidars,
    draw_overlays,
    width_on_page,
    write_overlays,
)
from calibgraph.report.plots import reprojection_errors, residual_map
from calibgraph.report.tables import moved_cells


def write_report(result: Calibration, path: Path | str) -> Path:
    """Write a result as one HTML page that needs nothing else; returns its path.

    Images and clouds are read from the files that the result names; if they cannot be read, the
    page names the cause and leaves their pictures out. Without correspondences there are no
    pictures of residuals.

    Raises:
        CorrespondenceError: if the result's correspondences do not belong to its rig.
        FileError: if the page cannot be written.
    """
    path = Path(path)
    write_text(path, render_page(result))
    return path


def render_page(result: Calibration) -> str:
    """The page as text, its diagrams drawn into it."""
    rig, guess = result.rig, result.initial_rig
    maps = {
        name: residual_map(rig.cameras[name], errors, result.residuals[name].gate_px)
        for name, errors in reprojection_errors(result).items()
    }
    overlays, overlays_left_out = dict[str, tuple[str, ...]](), None
    if (shown := _shown_frame(result)) is None:
        overlays_left_out = "the result was made from a table, which names no images"
    elif rig.cameras:
        overlays, overlays_left_out = draw_overlays(shown, _before_and_after(result))
    cameras = [
        {
            "name": name,
            "anchor": f"camera-{index}",
            "verdict": result.camera_verdicts[name],
            "moved": pose_error(camera.T_camera_lidar, guess.T_camera_lidar[name]),
            "sigmas": result.error_bar(name),
            "overlays": overlays.get(name),
            "residuals": maps.get(name),
            "rounds": [cameras[name] for cameras in result.rounds if name in cameras],
        }
        for index, (name, camera) in enumerate(rig.cameras.items())
    ]
    lidars = [
        {
            "name": name,
            "anchor": f"lidar-{index}",
            "verdict": verdict,
            "moved": moved_cells(result.T_base_lidar[name], guess.T_base_lidar.get(name)),
            "sigmas": result.error_bar(name),
        }
        for index, (name, verdict) in enumerate(result.lidar_verdicts.items())
    ]
    views, views_left_out = draw_lidars(result) if lidars else (None, "")
    summary = result.summary
    return page_template("calibgraph.report").render(
        result=result,
        cameras=cameras,
        lidars=lidars,
        views=views,
        views_left_out=views_left_out,
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
        width_on_page=width_on_page,
        depth_scale=depth_scale(),
        shown=shown,
        overlays_left_out=overlays_left_out,
        residuals_left_out=not maps,
        config=yaml.safe_dump(result.config.model_dump(), sort_keys=False, allow_unicode=True),
        frames_sentence=FRAMES_SENTENCE,
        tangent_sentence=TANGENT_SENTENCE,
    )


def _shown_frame(result: Calibration) -> Frame | None:
    """In the middle of those that were used; None of a result of a table."""
    return frame_of_entry(result.frames[len(result.frames) // 2]) if result.frames else None


def _before_and_after(result: Calibration) -> dict[str, tuple[Camera, Camera]]:
    guess, found = result.initial_rig.cameras, result.rig.cameras
    return {name: (camera, found[name]) for name, camera in guess.items()}


def _camera_pairs(result: Calibration) -> list[dict[str, Any]]:
    """What each pair of cameras sees in common, in the rig's order, with the check of it."""
    table, rows = result.camera_matches, list[dict[str, Any]]()
    if table is None:
        return rows
    for a, b in table.pairs():
        matches = table.of_pair(a, b)
        known = np.isfinite(matches.planes_lidar_per_m[:, :, 0]).any(axis=1)
        name = f"relative pose of {a} and {b} by images"
        rows.append({
            "name": f"{a}, {b}", "matches": len(matches), "surfaces": int(known.sum()),
            "frames": len(np.unique(matches.frame)),
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


def write_result(result: Calibration, folder: Path, *, with_report: bool = True) -> list[Path]:
    """Write a result in place of an older one: of images with an overlay picture per camera.

    After an error none of them appears, and the calibration is the last. Returns the files.
    """
    require_own_tables(folder)
    with written_together(folder, last=CALIBRATION_FILE) as new:
        written = [result.save(new)]
        tables = (new / CORRESPONDENCES_FILE, new / CAMERA_MATCHES_FILE)
        written += [table for table in tables if table.exists()]
        if (shown := _shown_frame(result)) is not None:
            verdicts = {name: one.status for name, one in result.camera_verdicts.items()}
            written += write_overlays(shown, _before_and_after(result), new, verdicts)
        if with_report:
            write_text(new / REPORT_FILE, render_page(result))
            written.append(new / REPORT_FILE)
        names = {path.name for path in new.iterdir()}
    for name in set(TABLES) - names:
        (folder / name).unlink(missing_ok=True)  # of the result that this one replaces
    return [folder / path.name for path in written]


def check_cells(check: Check) -> tuple[str, str, str]:
    """The value of a check and its thresholds, as text; empty where there is none.

    The order of the thresholds gives the side on which values are bad. A status that the value
    does not give, since it depends on more, has none.
    """
    if check.value is None:
        return "", "", ""
    if check.warn is None or check.fail is None or not check.is_graded:
        return in_unit(check.value, check.unit), "", ""
    sign = "<" if check.warn > check.fail else ">"
    warn, fail = (  # empty if no value can be bad
        f"{sign} {in_unit(limit, check.unit)}" if is_reachable(limit, check.unit, sign) else ""
        for limit in (check.warn, check.fail)
    )
    found = beside(check.value, check.fail if check.status == "FAIL" else check.warn, check.unit)
    return found, warn, fail


def matrix_text(T: Array) -> str:
    """The rows of a matrix, a line each."""
    return "\n".join(" ".join(f"{value: .6f}" for value in row) for row in T)


def pose_text(T: Array) -> str:
    """Translation and quaternion of a transform, with their order and unit."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return (
        f"translation x y z   = {' '.join(f'{v:.6f}' for v in T[:3, 3])} m\n"
        f"quaternion  x y z w = {x:.6f} {y:.6f} {z:.6f} {w:.6f}"
    )


def recording_name(result: Calibration) -> str:
    """What a result was made from: the last two folders of its recordings, or its table, if any."""
    if not result.frames:
        return Path(next(iter(result.inputs), "")).name
    found = {os.path.commonpath([e["cloud"], *e["images"].values()]) for e in result.frames}
    return ", ".join("/".join(Path(each).parts[-2:]) for each in sorted(found))

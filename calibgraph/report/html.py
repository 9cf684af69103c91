"""The page: the template, filled with all of a result; and the files of a result in its folder."""

import shlex
from pathlib import Path

import yaml

from calibgraph.file_sets import written_together
from calibgraph.files import write_text
from calibgraph.io.dataset import Dataset
from calibgraph.io.formats.names import EXPORT_FORMATS
from calibgraph.model.calibration import FRAMES_SENTENCE, TANGENT_SENTENCE, Calibration
from calibgraph.model.places import describe_places
from calibgraph.model.result_files import (
    CALIBRATION_FILE,
    CAMERA_MATCHES_FILE,
    CORRESPONDENCES_FILE,
    REPORT_FILE,
    TABLES,
    require_own_tables,
)
from calibgraph.report.camera_section import camera_diagrams, camera_section
from calibgraph.report.frames import recording_name
from calibgraph.report.kit import load_template
from calibgraph.report.page_overlays import draw_overlays
from calibgraph.report.page_pairs import match_scale, pair_sections
from calibgraph.report.point_overlay import write_overlays
from calibgraph.report.reprojection_errors import errors_before_after


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
    errors = errors_before_after(result)
    overlays, overlays_left_out = draw_overlays(result, errors)
    cameras = [
        camera_section(result, name, index, overlays.get(name), errors=errors.get(name),
                       diagrams=camera_diagrams(result, name, errors.get(name)))
        for index, name in enumerate(result.rig.cameras)
    ]  # fmt: skip
    summary = result.summary
    return load_template("page.html.j2").render(
        result=result,
        cameras=cameras,
        summary=summary,
        recording=recording_name(result),
        places=describe_places(result.places) if result.places else "",
        actions=summary.actions or ("Deploy it: see below.",),
        export_command=_export_command(result),
        export_formats=EXPORT_FORMATS,
        pairs={name: result.error_bar(name) for name in result.pair_covariance},
        between=pair_sections(result),
        match_scale=match_scale(),
        overlays_left_out=overlays_left_out,
        residuals_left_out=not errors,
        config=yaml.safe_dump(result.config.model_dump(), sort_keys=False, allow_unicode=True),
        frames_sentence=FRAMES_SENTENCE,
        tangent_sentence=TANGENT_SENTENCE,
    )


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

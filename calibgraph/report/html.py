"""The page: the template, filled with all of a result."""

import shlex
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from calibgraph.files import write_text
from calibgraph.io.formats.names import EXPORT_FORMATS
from calibgraph.model.calibration import FRAMES_SENTENCE, TANGENT_SENTENCE, Calibration
from calibgraph.report.camera_section import camera_section
from calibgraph.report.frames import recording_name
from calibgraph.report.kit import load_template
from calibgraph.report.page_overlays import draw_overlays
from calibgraph.report.page_pairs import match_scale, pair_sections
from calibgraph.report.reprojection_errors import errors_before_after

Array = NDArray[np.float64]

_CAN_I_USE_IT = {
    ("PASS", False): "Yes. All checks passed.",
    ("WARN", True): "With care: nothing seems wrong, but the data leave too much open.",
    ("WARN", False): "With care: read the reasons, and look at the pictures.",
    ("FAIL", False): "No. Do not use this result.",
}


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
    write_text(path, report_html(result))
    return path


def report_html(result: Calibration) -> str:
    """The page as text; see :func:`write_report`."""
    errors = errors_before_after(result)
    overlays, overlays_left_out = draw_overlays(result, errors)
    cameras = [
        camera_section(result, name, index, overlays.get(name), errors=errors.get(name))
        for index, name in enumerate(result.rig.cameras)
    ]
    summary = result.summary
    return load_template("page.html.j2").render(
        result=result,
        cameras=cameras,
        summary=summary,
        recording=recording_name(result),
        usable=_usable(result),
        actions=summary.actions or ("Deploy it: see below.",),
        accuracy=_accuracy(result),
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


def _usable(result: Calibration) -> str:
    """Whether the result can be used: of a rig that FAILs, the cameras that do not may be."""
    failed = [name for name, found in result.camera_verdicts.items() if found.status == "FAIL"]
    if failed and len(failed) < len(result.camera_verdicts):
        return f"Not of {', '.join(failed)}. The other cameras by their own verdicts."
    summary = result.summary
    return _CAN_I_USE_IT[summary.status, summary.cannot_tell]


def _export_command(result: Calibration) -> str:
    """The command that exports the cameras that did not FAIL; empty if there are none."""
    usable = [n for n in result.rig.cameras if result.camera_verdicts[n].status != "FAIL"]
    if not usable:
        return ""
    words = ["calibgraph", "export", ".", "--format", "ros2-launch", "--out", "rig.launch.xml"]
    if len(usable) < len(result.rig.cameras):
        words += [word for name in usable for word in ("--camera", name)]
    return shlex.join(words)


def _accuracy(result: Calibration) -> str:
    """The largest standard deviations over all cameras, and where there are none, in sentences."""
    bars = {name: result.error_bar(name) for name in result.rig.cameras}
    known = {name: both for name, both in bars.items() if both is not None}
    failed = [name for name in bars if not result.error_bar_holds(name)]
    few = [name for name in bars if name not in known and name not in failed]
    sentences = [_worst_axes(known)] if known else []
    for names, why in (
        (failed, "FAIL, an error bar would not hold"),
        (few, "the correspondences do not determine them"),
    ):
        of_some = f" for {', '.join(names)}" if len(names) < len(bars) else ""
        sentences += [f"Unknown{of_some}: {why}."] if names else []
    return " ".join(sentences)


def _worst_axes(known: Mapping[str, tuple[Array, Array]]) -> str:
    rotation = max(known, key=lambda name: float(known[name][0].max()))
    translation = max(known, key=lambda name: float(known[name][1].max()))
    return (
        f"Worst axis of any camera: {known[rotation][0].max():.3f} deg ({rotation}) and "
        f"{known[translation][1].max():.2f} cm ({translation}), one standard deviation."
    )

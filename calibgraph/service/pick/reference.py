"""What a session gives: the table of its pairs, and the reference with its error bars."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibgraph.errors import CalibrationError
from calibgraph.io.rigs import REFERENCE_FILE
from calibgraph.model.geometry import degrees_and_centimetres
from calibgraph.model.result_files import WRITTEN_KEY, table_mark
from calibgraph.model.rig import Rig
from calibgraph.outputs import Output, marked_yaml, yaml_mark
from calibgraph.service.pick.estimate import PickEstimate
from calibgraph.service.pick.session import SESSION_FILE, SESSION_FORMAT, Pair, to_table

TABLE_FILE = "picked.parquet"
PICK = "calibgraph pick"


def outputs_of_pick(folder: Path) -> list[Output]:
    """The files of a session in its folder."""
    return [
        Output(folder / SESSION_FILE, "pick", (SESSION_FORMAT.encode(),)),
        Output(folder / TABLE_FILE, "pick", (table_mark(PICK),)),
        marked_yaml(folder / REFERENCE_FILE, "pick"),
    ]


def reference_rig(estimate: PickEstimate) -> Rig:
    """The rig of the cameras that the pairs determine, each with its covariance."""
    solve = estimate.solve
    if solve is None or solve.covariance is None:
        reasons = [word for camera in estimate.cameras.values() for word in camera.warnings]
        why = f" ({reasons[0]})" if reasons else ""
        raise CalibrationError(
            f"the pairs do not determine a camera yet{why}; pick at least 4 of one camera, "
            "not on one line"
        )
    cameras = {
        name: camera.model_copy(update={"covariance": solve.covariance_of(name)})
        for name, camera in solve.rig.cameras.items()
    }
    return solve.rig.model_copy(update={"cameras": cameras})


def write_reference(folder: Path, estimate: PickEstimate, pairs: Sequence[Pair]) -> list[Path]:
    """Write ``reference.yaml``, with error bars, and the pairs as a table of correspondences.

    Raises:
        CalibrationError: if the pairs determine no camera.
        FileError: if a file of these names is there that is not of a session.
    """
    rig = reference_rig(estimate)
    table = to_table(pairs)
    paths = [folder / TABLE_FILE, folder / REFERENCE_FILE]
    replace(table, metadata={**table.metadata, WRITTEN_KEY: PICK}).save(paths[0])
    rig.save(paths[1], first_line="\n".join([yaml_mark("pick"), *_sigma_lines(rig)]))
    return paths


def _sigma_lines(rig: Rig) -> list[str]:
    """A comment per camera: its standard deviations, for people."""
    lines = ["# standard deviations about and along the camera's x, y and z:"]
    for name, camera in rig.cameras.items():
        degrees, centimetres = degrees_and_centimetres(np.asarray(camera.covariance))
        turn = " ".join(f"{value:.3f}" for value in degrees)
        shift = " ".join(f"{value:.2f}" for value in centimetres)
        lines.append(f"#   {json.dumps(name)}: {turn} deg, {shift} cm")
    return lines

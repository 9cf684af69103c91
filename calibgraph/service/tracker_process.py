"""Trackers in their process: bytes of frames in, durable updates out."""

import gc
import json
import shutil
import sys
from io import BytesIO
from itertools import chain
from pathlib import Path

import pyarrow as pa

from calibgraph.child_process import answer_requests, failed, memory_limit
from calibgraph.errors import CalibrationError, MotionError
from calibgraph.files import sync_to_disk, write_bytes, write_text
from calibgraph.io.rigs import load_rig
from calibgraph.io.tables import from_arrow
from calibgraph.model.config import config_from
from calibgraph.report.as_json import result_summary
from calibgraph.stdout import finite
from calibgraph.tracking import DurableCalibrator, warm_up_tracker
from calibgraph.tracking.assessment import json_lines
from calibgraph.tracking.frames import Item, frames_of_lines, frames_of_table
from calibgraph.tracking.state import require_poses_alone

Held = dict[Path, DurableCalibrator]
_ARROW = b"\xff\xff\xff\xff"
"""The first bytes of an Arrow IPC stream, which no JSON has."""


def answer(held: Held, request: tuple[str, Path, bytes, str]) -> tuple[int, str]:
    """Answer a method, folder, body and settings; after an error the state on disk counts."""
    method, folder, body, config = request
    rig, settings = folder / "rig.yaml", folder / "config.json"
    is_gone = not rig.exists()
    if is_gone != (method == "PUT"):
        return (404, "no such tracker") if is_gone else (409, "there is one; remove it first")
    try:
        if method == "PUT":
            shutil.rmtree(folder, ignore_errors=True)  # of one that was removed in part
            folder.mkdir(mode=0o700)
            write_text(settings, config)
            write_bytes(rig, body)
            sync_to_disk(folder.parent)
        if method != "DELETE":
            if folder not in held:
                given = config_from(json.loads(settings.read_text()), "config")
                require_poses_alone(given)
                held[folder] = DurableCalibrator(folder / "state", load_rig(rig), given)
            if method == "POST":
                return 200, _take_frames(held[folder], body)
            tracker = held[folder].tracker
            state = {"frame": tracker.frame, **result_summary(tracker.calibration(), [])}
            return 200, json.dumps(finite(state))
        is_gone, status, text = True, 200, "null"
    except Exception as error:
        how = failed(error, {f"{folder}/": "", str(folder): "the tracker"})
        status = {"bad input": 422, "out of memory": 413, "io": 507}.get(str(how.error_kind), 500)
        text = str(how.error)
    if folder in held:
        held.pop(folder).abandon()
    if is_gone:
        rig.unlink(missing_ok=True)  # without it there is no tracker
        shutil.rmtree(folder, ignore_errors=True)
    return status, text


def _frames_of(body: bytes) -> list[Item]:
    """The frames of JSON lines, or of a table of correspondences as an Arrow IPC stream."""
    if not body.startswith(_ARROW):
        return [*frames_of_lines(BytesIO(body), "frames")]
    try:
        table = pa.ipc.open_stream(body).read_all()
        table.validate(full=True)  # what is sent may be damaged
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"not a whole Arrow IPC stream ({error}); send it again") from error
    return [*frames_of_table(from_arrow(table))]


def _take_frames(calibrator: DurableCalibrator, body: bytes) -> str:
    """Take in frames by one write; one with a motion of no vehicle refuses all of them."""
    try:
        items = _frames_of(body)
    except MotionError as error:  # slower frames look right, and are not
        raise ValueError(f"{error}; none of these frames was taken in") from error
    frames = [one for one in items if not isinstance(one, CalibrationError)]
    last = calibrator.tracker.frame
    new = [one for one in frames if last is None or one.frame > last]
    found = calibrator.update_all(new)
    errors = [one for one in (*items, *found) if isinstance(one, CalibrationError)]
    groups = (one for one in found if not isinstance(one, CalibrationError))
    lines = ", ".join(json_lines([*chain.from_iterable(groups)]))
    known, refused = len(frames) - len(new), json.dumps([*map(str, errors)])
    return f'{{"updates": [{lines}], "known": {known}, "refused": {refused}}}'


if __name__ == "__main__":
    warm_up_tracker()
    gc.freeze()  # what is loaded by now stays: each full collection would visit it
    held_trackers: Held = {}
    with memory_limit(int(sys.argv[2])):
        answer_requests(lambda request, _: answer(held_trackers, request))

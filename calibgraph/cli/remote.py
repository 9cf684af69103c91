"""Commands that a server carries out: ``calibgraph --server URL``."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.cli.terminal import progress_bar

if TYPE_CHECKING:
    from calibgraph.cli.matching_options import MatchingOptions
    from calibgraph.client import Client
    from calibgraph.io.dataset import Dataset
    from calibgraph.model.calibration import Calibration
    from calibgraph.model.config import Config

SERVER: ContextVar[str | None] = ContextVar("SERVER", default=None)
"""The option ``--server`` of this call."""
COMMANDS = ("calibrate", "solve", "check")


def require_known(command: str | None) -> None:
    """Check that a command can be carried out by a server."""
    from calibgraph.errors import CalibrationError

    if SERVER.get() is not None and command not in COMMANDS:
        raise CalibrationError(f"--server is for {', '.join(COMMANDS)}")


@contextmanager
def _done(
    kind: str, rig: Path | None, inputs: Mapping[str, Sequence[Path]], settings: Mapping[str, Any]
) -> Iterator[tuple[Client, str]]:
    """A job with its result, and the client to fetch it; Ctrl-C cancels it.

    The rig is sent as a rig file: any rig can be read from the path.
    """
    from calibgraph.errors import CalibrationError
    from calibgraph.files import write_yaml
    from calibgraph.io.rigs import load_rig

    try:
        from calibgraph.client import Client
    except ImportError as error:
        text = "--server: httpx is not installed; pip install 'calibgraph[client]'"
        raise CalibrationError(text) from error
    with Client(SERVER.get() or "") as client, tempfile.TemporaryDirectory() as folder:
        if rig is not None:
            inputs = {**inputs, "rig": [Path(folder) / "rig.yaml"]}
            write_yaml(inputs["rig"][0], load_rig(rig).model_dump(mode="json"))
        with progress_bar("sending") as progress:
            id = client.submit(kind, inputs, settings).id
            try:
                client.wait(id, progress)
            except KeyboardInterrupt:
                client.cancel(id)
                raise
        yield client, id


def _fetch(
    client: Client, id: str, out: Path, change: Callable[[Calibration], Calibration]
) -> tuple[Calibration, list[Path]]:
    """Write the result's files, with the paths of this machine; the result, and the files."""
    from calibgraph.io.calibrations import load_calibration

    names = client.result(id)["files"]
    client.download(id, out)
    result = change(load_calibration(out))
    result.save(out)
    return result, [out / name for name in names]


def solve(
    rig: Path, table: Path, config: Config, terms: str, out: Path
) -> tuple[Calibration, list[Path]]:
    """Solve a table on the server; the result, and the files written into ``out``."""
    from calibgraph.files import sha256

    settings = {"config": config.model_dump(mode="json"), "terms": terms}
    with _done("solve", rig, {"correspondences": [table]}, settings) as (client, id):
        return _fetch(client, id, out, lambda r: r.with_inputs({str(table): sha256(table)}))


def calibrate(
    data: Dataset, matching: MatchingOptions, config: Config, terms: str, out: Path
) -> tuple[Calibration, list[Path]]:
    """Calibrate a dataset on the server; the result, and the files written into ``out``."""
    settings = {
        **_search_of(matching),
        "config": config.model_dump(mode="json"),
        "terms": terms,
        "frames": matching.frames,
        "time_limit_s": matching.time_limit_s,
    }
    inputs = {"recording": list(data.folders)}
    if matching.matcher != "structure":
        inputs["correspondences"] = [Path(matching.matcher)]
    with _done("calibration", matching.rig, inputs, settings) as (client, id):
        return _fetch(client, id, out, lambda result: _here(result, data))


def _search_of(matching: MatchingOptions) -> dict[str, Any]:
    """The settings of the search; what a server does not offer is refused."""
    from calibgraph.cli.matching_options import MatchingOptions
    from calibgraph.errors import CalibrationError

    known = ("rig", "matcher", "frames", "time_limit_s", "search_deg", "search_m")
    with_config = ("estimate",) if matching.lens_parts else ()
    for name, value in vars(matching).items():
        if name not in (*known, *with_config) and value != getattr(MatchingOptions(), name):
            raise CalibrationError(f"--{name.replace('_', '-')}: not with --server")
    if matching.matcher == "cmrnext":
        raise CalibrationError("--matcher cmrnext: not with --server")
    given = {"search_deg": matching.search_deg, "search_m": matching.search_m}
    numbers = {name: value for name, value in given.items() if value not in (None, "none")}
    return {"search": "none" not in given.values(), **numbers}


def _here(result: Calibration, data: Dataset) -> Calibration:
    """The result with the paths of the files here, in place of the server's."""
    from calibgraph.pipeline import hash_inputs

    frames = {frame.index: frame for frame in (*data.recorded, *data.frames)}
    used = replace(data, frames=tuple(frames[entry["frame"]] for entry in result.frames))
    entries = tuple(frame.entry() for frame in used.frames)
    return replace(result, frames=entries).with_inputs(hash_inputs(used))


def check(
    rig: Path, data: Dataset, frames: str | None, settings: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Check a deployed calibration on the server; the summary of the audit."""
    inputs = {"recording": list(data.folders)}
    with _done("check", rig, inputs, {**settings, "frames": frames}) as (client, id):
        return client.result(id)

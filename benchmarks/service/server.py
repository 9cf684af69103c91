"""A server of its own process for the benchmarks, and small problems that have one answer each."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import psutil
from numpy.typing import NDArray

from calibgraph import MatcherErrors, load_rig, perturb, simulate_correspondences, solve
from calibgraph.files import write_yaml
from calibgraph.simulation.rigs import rig_of

_READY_S = 120.0
SETTINGS = '{"report": false}'


@dataclass(frozen=True)
class Problem:
    """A small problem, and what the library makes of it.

    Attributes:
        rig, table: contents of the files.
        T_camera_lidar: (4, 4) of each camera, by its name.
    """

    rig: bytes
    table: bytes
    T_camera_lidar: dict[str, NDArray[np.float64]]

    @property
    def files(self) -> dict[str, bytes]:
        """As they are sent."""
        return {"rig": self.rig, "correspondences": self.table}

    def is_answered_by(self, result: dict[str, object]) -> bool:
        """Whether a result is this problem's: others differ by centimetres."""
        cameras = result["cameras"]
        assert isinstance(cameras, dict)
        return all(
            np.allclose(cameras[name]["T_camera_lidar"], T, rtol=0, atol=1e-9)
            for name, T in self.T_camera_lidar.items()
        )


def make_problems(folder: Path, count: int, *, frames: int = 3, matches: int = 40) -> list[Problem]:
    """Problems of two cameras, with different truths, written into a folder too."""
    return [_problem(folder / str(i), i, frames, matches) for i in range(count)]


def _problem(folder: Path, seed: int, frames: int, matches: int) -> Problem:
    folder.mkdir(parents=True)
    rig, table = folder / "rig.yaml", folder / "table.parquet"
    truth = perturb(rig_of("kitti"), rotation_deg=1.0, translation_m=0.1, seed=seed)
    errors = MatcherErrors(noise_px=0.5)
    simulate_correspondences(truth, frames=frames, matches=matches, errors=errors, seed=seed).save(
        table
    )
    write_yaml(
        rig,
        perturb(truth, rotation_deg=1.0, translation_m=0.1, seed=seed + 1000).model_dump(
            mode="json"
        ),
    )
    result = solve(load_rig(rig), table)
    poses = {name: camera.T_camera_lidar for name, camera in result.rig.cameras.items()}
    return Problem(rig.read_bytes(), table.read_bytes(), poses)


class Server:
    """``calibgraph serve`` on a port of loopback.

    Args:
        data: its folder.
        port: number.
        options: further ones of the command.
    """

    def __init__(self, data: Path, port: int, options: Sequence[str] = ()) -> None:
        self.url = f"http://127.0.0.1:{port}"
        self._words = [
            sys.executable, "-m", "calibgraph", "serve", "--data", str(data),
            "--port", str(port), "--free-gb", "0", *options,
        ]  # fmt: skip
        self._log = data.with_suffix(".log")

    def start(self) -> None:
        """Start it and wait until it can work."""
        with self._log.open("ab") as log:
            self.process = psutil.Popen(self._words, stdout=log, stderr=subprocess.STDOUT)
        end = time.monotonic() + _READY_S
        while time.monotonic() < end:
            if self.process.poll() is not None:
                raise RuntimeError(f"the server has ended; see {self._log}")
            with suppress(httpx.HTTPError):
                if httpx.get(f"{self.url}/readyz", timeout=5).status_code == httpx.codes.OK:
                    return
            time.sleep(0.05)
        raise TimeoutError(f"no server at {self.url}; see {self._log}")

    def stop(self) -> None:
        """End it as SIGTERM does."""
        self.process.terminate()
        self.process.wait(60)

    def kill(self) -> None:
        """End it as kill -9 does."""
        self.process.kill()
        self.process.wait()

    def workers(self) -> list[psutil.Process]:
        """The processes of jobs and trackers."""
        return list(self.process.children(recursive=True))

    def memory_mb(self) -> tuple[float, float]:
        """Resident memory of the server and of the largest worker."""
        workers = [process.memory_info().rss for process in self.workers()]
        return self.process.memory_info().rss / 1e6, max(workers, default=0) / 1e6

    def own_processor_s(self) -> float:
        """Processor time of the server alone so far."""
        return sum(self.process.cpu_times()[:2])

    def processor_s(self) -> float:
        """Processor time of the server and its workers so far, of those too that have ended."""
        return sum(sum(process.cpu_times()[:4]) for process in (self.process, *self.workers()))

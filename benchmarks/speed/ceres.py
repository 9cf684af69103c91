"""The same solve in Ceres, where its headers are installed: see ``ceres_baseline.cpp``."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.speed.solvers import CONFIG, GATE_PX, SCALE_PX, Passes, Problem, Transforms

Array = NDArray[np.float64]

SOURCE = Path(__file__).with_name("ceres_baseline.cpp")
INCLUDES = (Path("/usr/include"), Path("/usr/local/include"))
COMPILE = ("g++", "-std=c++17", "-O3", "-march=native", "-DNDEBUG")
LIBRARIES = ("-lceres", "-lglog")


@dataclass(frozen=True, eq=False)
class CeresRun:
    """One run of the program.

    Attributes:
        passes: what it found.
        wall_s, cpu_s: of both passes with building their problems, without reading the file.
    """

    passes: Passes
    wall_s: float
    cpu_s: float


def why_not() -> str:
    """Why Ceres cannot be compared with, or nothing if it can."""
    if shutil.which(COMPILE[0]) is None:
        return f"no compiler {COMPILE[0]}"
    if not any((folder / "ceres" / "ceres.h").is_file() for folder in INCLUDES):
        return "ceres/ceres.h not found: apt-get install libceres-dev"
    return ""


def compile_program(folder: Path) -> Path:
    """Compile the program into a folder.

    Raises:
        CalledProcessError: if it does not compile; the compiler's messages are on stderr.
    """
    program = folder / "ceres_baseline"
    eigen = [f"-I{path / 'eigen3'}" for path in INCLUDES]
    subprocess.run([*COMPILE, *eigen, SOURCE, "-o", program, *LIBRARIES], check=True)
    return program


def solve_ceres(program: Path, problem: Problem, gate_at: Transforms) -> CeresRun:
    """Both passes of Ceres, one thread.

    Args:
        program: of :func:`compile_program`.
        problem: with its start.
        gate_at: T_camera_lidar at which the second pass drops correspondences, as
            ``Problem.without_outliers``.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "problem"
        _write(path, problem, gate_at)
        done = subprocess.run([program, path], check=True, stdout=subprocess.PIPE, text=True)
    wall_s, cpu_s, *poses = map(float, done.stdout.split())
    first, second = np.reshape(poses, (2, len(problem.rows), 6))
    passes = Passes(_transforms(problem, first), _transforms(problem, second))
    return CeresRun(passes, wall_s, cpu_s)


def _write(path: Path, problem: Problem, gate_at: Transforms) -> None:
    """The problem, in the layout that the program reads."""
    rows = len(problem.table)
    weights = (SCALE_PX, CONFIG.prior_weight, CONFIG.relative_prior_weight)
    with path.open("wb") as file:
        np.array([len(problem.rows), rows, *weights], np.float64).tofile(file)
        for name in problem.rows:
            lens = problem.rig.cameras[name].intrinsics_px
            intrinsics = [lens.fx, lens.fy, lens.cx, lens.cy]
            np.append(intrinsics, problem.T_hat[name].ravel()).tofile(file)
        for index, (name, part) in enumerate(problem.rows.items()):
            kept = np.linalg.norm(problem.residuals(name, gate_at[name]), axis=1) <= GATE_PX
            of_camera = np.full(len(kept), float(index))
            columns = (of_camera, part.points_lidar_m, part.pixels_px, kept.astype(np.float64))
            np.column_stack(columns).tofile(file)


def _transforms(problem: Problem, poses: Array) -> Transforms:
    """(4, 4) per camera of angle-axis and translation, (cameras, 6)."""
    found = {}
    for name, pose in zip(problem.rows, poses, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:]
        found[name] = T
    return found

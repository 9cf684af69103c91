"""Time and memory from 10^3 to 10^8 correspondences: tables streamed from disk.

    python -m benchmarks.speed.scaling [--rows 1e3 ... 1e8] [--folder DIR]

Parquet tables of a dense matcher (2 cameras, frames of up to 50,000 matches each,
float32) are written to --folder and solved there, each in a process of its own, whose peak resident
memory is measured; 10^8 rows take 3.6 GB on disk until they are solved. Up to --whole-up-to rows,
the table is also loaded whole.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from benchmarks.tables import ROOT, Table, parser_of, publish
from calibgraph import (
    Correspondences,
    MatcherErrors,
    load_correspondences,
    perturb,
    simulate_correspondences,
    solve,
)
from calibgraph.simulation.rigs import rig_of

Row = dict[str, Any]

RIG = "kitti"
MATCHES = 50_000  # of one camera in one frame
FRAMES = 5  # at least
DRAWN_FRAMES = 10  # repeated with other noise
ERRORS = MatcherErrors(noise_px=0.7, frame_noise_px=0.3, outlier_share=0.15)
WARM_UP_MATCHES = 100


def main() -> None:
    """Print both tables."""
    options = parse_options()
    if options.child is not None:
        print(json.dumps(measure_solve(options.child, whole=options.whole)))
        return
    rows = tuple(table_cells(row) for row in measure_tables(options))
    table = Table("Tables solved from disk", TABLE_COLUMNS, rows)
    publish("speed.scaling", [table], record=options.record)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = parser_of(__doc__)
    every = [10.0**k for k in range(3, 9)]
    parser.add_argument("--rows", type=float, nargs="*", default=every, help="of the tables")
    parser.add_argument("--whole-up-to", type=float, default=1e7, metavar="ROWS")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--whole", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def measure_tables(options: argparse.Namespace) -> Iterator[Row]:
    """Write, solve and remove a table of each size."""
    for count in map(int, options.rows):
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            path = write_table(count, Path(folder) / "table.parquet")
            file_mb = path.stat().st_size / 1e6
            for whole in (False, True)[: 1 + (count <= options.whole_up_to)]:
                row = {"rows": count, "file_mb": file_mb, "whole": whole}
                row |= measure_in_process(path, whole=whole)
                print(", ".join(table_cells(row)), flush=True)
                yield row


def write_table(count: int, path: Path) -> Path:
    """Write a table of about so many rows, a row group for each camera and frame."""
    frames = max(FRAMES, round(count / 2 / MATCHES))
    rig, rng = rig_of(RIG), np.random.default_rng(0)
    drawn = simulate_correspondences(
        rig, frames=min(frames, DRAWN_FRAMES), matches=round(count / 2 / frames), errors=ERRORS
    )
    parts = {name: drawn.of_camera(name) for name in rig.cameras}
    writer = None
    for frame in range(frames):
        for name, part in parts.items():
            rows = part.select(part.frame == frame % DRAWN_FRAMES)
            table = row_group(name, frame, rows, rng)
            writer = writer or parquet.ParquetWriter(path, table.schema)
            writer.write_table(table)
    assert writer is not None
    writer.close()
    return path


def row_group(name: str, frame: int, rows: Correspondences, rng: np.random.Generator) -> pa.Table:
    """The matches of a frame, as float32, with noise added."""
    pixels_px = rows.pixels_px + rng.normal(0.0, 0.5, rows.pixels_px.shape)
    columns = np.column_stack([pixels_px, rows.points_lidar_m]).astype(np.float32)
    keys = ("u_px", "v_px", "x_m", "y_m", "z_m")
    return pa.table(
        {
            "camera": pa.array([name]).dictionary_encode().take(pa.array([0] * len(rows))),
            "frame": np.full(len(rows), frame),
            **dict(zip(keys, np.ascontiguousarray(columns.T), strict=True)),
            "confidence": rows.confidence,
        }
    )


def measure_in_process(path: Path, *, whole: bool) -> Row:
    """Run :func:`measure_solve` in a fresh process."""
    command = [sys.executable, "-m", "benchmarks.speed.scaling", "--child", str(path)]
    command += ["--whole"] if whole else []
    found = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return dict(json.loads(found.stdout))


def measure_solve(path: Path, *, whole: bool) -> Row:
    """Solve a table: seconds to read and preprocess it, and for the rest; peak resident memory."""
    guess = perturb(rig_of(RIG), rotation_deg=0.5, translation_m=0.05)
    solve(guess, simulate_correspondences(rig_of(RIG), frames=FRAMES, matches=WARM_UP_MATCHES))
    begun = time.perf_counter()
    result = solve(guess, load_correspondences(path) if whole else path)
    seconds = time.perf_counter() - begun
    read_s = seconds - sum(v for k, v in result.timings_s.items() if k != "preprocess")
    return {
        "read_s": read_s,
        "rest_s": seconds - read_s,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "kept": sum(count["capped"] for count in result.counts.values()),
        "verdict": result.verdict.status,
    }


TABLE_COLUMNS = (
    "rows", "file [MB]", "table", "read and filter [s]", "solve and checks [s]", "peak [MB]",
    "kept by the grid",
)  # fmt: skip


def table_cells(row: Row) -> tuple[str, ...]:
    """A row of the first table."""
    return (
        str(row["rows"]), f"{row['file_mb']:.1f}", "whole" if row["whole"] else "streamed",
        f"{row['read_s']:.2f}", f"{row['rest_s']:.2f}", f"{row['peak_mb']:.0f}", str(row["kept"]),
    )  # fmt: skip


if __name__ == "__main__":
    main()

"""300 tables and 12 recordings: equal rows from all engines, speed-up, killed workers and commands.

python -m benchmarks.fleet.engines FOLDER
"""

from __future__ import annotations

import argparse
import random
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import ROOT, Table, add_record_option, publish
from calibgraph.fleet.rows import read_rows
from calibgraph.fleet.run import run_fleet
from tests.draws.fleets import write_fleet
from tests.fleet.killing import kill_at_random


def main() -> None:
    """Write the fleet, and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--vehicles", type=int, default=300)
    parser.add_argument("--recordings", type=int, default=12)
    add_record_option(parser)
    given = parser.parse_args()
    shutil.rmtree(given.folder, ignore_errors=True)
    tables = write_fleet(given.folder / "in", given.vehicles)
    both = _with_recordings(tables, given.recordings)
    results = []
    for measure, manifest in ((_equal_rows, both), (_kills, tables), (_speed_up, tables)):
        results.append(measure(manifest, given.folder))
        print(results[-1].text(), flush=True)
    publish("fleet.engines", results, record=given.record)


def _with_recordings(manifest: Path, count: int) -> Path:
    """The manifest with recordings of the sample, each with a seed of its own."""
    text = manifest.read_text()
    for seed in range(count):
        settings = f"{{seed: {seed}, frames: '{seed % 3}::3', search_deg: 5, search_m: 0.3}}"
        text += f'"drive-{seed:02d}","{ROOT / "data" / "sample"}",,"{seed % 3}",1.0,"{settings}"\n'
    head, _, rest = text.partition("\n")
    lines = [line if line.startswith('"drive') else f"{line}," for line in rest.splitlines()]
    path = manifest.with_name("both.csv")
    path.write_text("\n".join([f'{head},"settings"', *lines, ""]))
    return path


def _speed_up(manifest: Path, folder: Path) -> Table:
    """Wall time with one and two jobs at once, in turn."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for turn in range(2):
        for slots, measured in seconds.items():
            start = time.perf_counter()
            run_fleet(str(manifest), str(folder / f"speed-{slots}-{turn}"), slots=slots)
            measured.append(time.perf_counter() - start)
    best = {slots: min(measured) for slots, measured in seconds.items()}
    rows = [(str(slots), f"{s:.1f}", f"{best[1] / s:.2f}") for slots, s in best.items()]
    return Table("Tables by jobs at once, processes", ("jobs at once", "s", "ratio"), (*rows,))


def _equal_rows(manifest: Path, folder: Path) -> Table:
    """The rows of every engine, compared bit by bit with those of processes."""
    rows, cells = {}, []
    for name in ("processes", "ray", "dask"):
        start = time.perf_counter()
        summary = run_fleet(str(manifest), str(folder / name), engine=name, slots=2)
        wall = time.perf_counter() - start
        rows[name] = _rows(folder / name)
        same = sum(rows[name].get(key) == row for key, row in rows["processes"].items())
        largest = _largest_difference(rows["processes"], rows[name])
        cells.append((name, f"{wall:.1f}", str(len(rows[name])), str(same), f"{largest:.1g}",
                      str(summary.retries)))  # fmt: skip
    columns = ("engine", "s", "rows", "equal to the bit", "largest difference of T", "retries")
    return Table("Engines", columns, (*cells,))


def _largest_difference(
    rows: dict[tuple[str, str], dict[str, Any]], others: dict[tuple[str, str], dict[str, Any]]
) -> float:
    """Of the elements of T; all else must be equal but the covariance, to 1e-9 of its size."""
    assert rows.keys() == others.keys()
    largest = 0.0
    for key, row in rows.items():
        a, b = dict(row), dict(others[key])
        T, others_T = np.array(a.pop("T_camera_lidar")), np.array(b.pop("T_camera_lidar"))
        largest = max(largest, float(np.abs(T - others_T).max()))
        C, others_C = a.pop("covariance"), b.pop("covariance")
        assert (C is None) == (others_C is None), key
        np.testing.assert_allclose(C or 0.0, others_C or 0.0, rtol=1e-9, atol=1e-15)
        assert a == b, key
    return largest


def _rows(out: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """By vehicle and camera, without the seconds; each once."""
    found = read_rows(str(out)).drop_columns(["seconds"]).to_pylist()
    rows = {(row["vehicle"], row["camera"]): row for row in found}
    assert len(rows) == len(found)
    return rows


def _kills(manifest: Path, folder: Path) -> Table:
    """Workers killed at random with every engine, and the command itself five times."""
    expected = {
        key: row for key, row in _rows(folder / "processes").items() if "drive" not in key[0]
    }
    cells = []
    for name in ("processes", "ray", "dask"):
        cells.append(_kill_workers(manifest, folder / f"killed-{name}", name, expected))
        cells.append(_kill_commands(manifest, folder / f"commands-{name}", name, expected))
    columns = ("killed", "kills", "failed or left before the last run", "done again", "rows")
    return Table("Kills", columns, (*cells,))


def _kill_workers(
    manifest: Path, out: Path, engine: str, expected: dict[tuple[str, str], Any]
) -> tuple[str, ...]:
    stop, kills = threading.Event(), [0]
    thread = threading.Thread(target=kill_at_random, args=(stop, kills), daemon=True)
    thread.start()
    try:
        summary = run_fleet(str(manifest), str(out), engine=engine, slots=2)
    finally:
        stop.set()
        thread.join()
    before = _seconds(out)
    run_fleet(str(manifest), str(out), slots=2)
    assert _rows(out) == expected
    failed, again = sum(summary.failures.values()), _count_again(before, _seconds(out))
    return f"workers, {engine}", str(kills[0]), str(failed), str(again), str(len(expected))


def _kill_commands(
    manifest: Path, out: Path, engine: str, expected: dict[tuple[str, str], Any]
) -> tuple[str, ...]:
    """Kill -9 the command five times while it works; no row that was there is made again."""
    command = [sys.executable, "-m", "calibgraph", "fleet", str(manifest), "--out", str(out),
               "--engine", engine, "--jobs", "2"]  # fmt: skip
    rng, before, kills, again = random.Random(0), dict[str, float](), 0, 0
    for _ in range(5):
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        while process.poll() is None and len(_seconds(out)) == len(before):
            time.sleep(0.5)
        time.sleep(rng.uniform(0.0, 4.0))
        kills += process.poll() is None
        process.kill()
        process.wait()
        before, earlier = _seconds(out), before
        again += _count_again(earlier, before)
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    after = _seconds(out)
    again += _count_again(before, after)
    assert _rows(out) == expected
    left = str(len(after) - len(before))
    return f"commands, {engine}", str(kills), left, str(again), str(len(expected))


def _count_again(before: dict[str, float], after: dict[str, float]) -> int:
    """The vehicles whose rows are no longer those that were there."""
    return sum(after.get(name) != seconds for name, seconds in before.items())


def _seconds(out: Path) -> dict[str, float]:
    """Per vehicle that is done, the wall time: no second try has the same."""
    if not out.exists() or not any(out.glob("bucket=*/rows.parquet")):
        return {}
    rows = [row for row in read_rows(str(out)).to_pylist() if row["status"] == "done"]
    return {row["vehicle"]: row["seconds"] for row in rows}


if __name__ == "__main__":
    main()

"""Errors on recorded data beside the reported error bars.

    python -m benchmarks.accuracy.sigma --starts 5 --picture out/sigma.png
    python -m benchmarks.accuracy.sigma --summary out/sigma.jsonl --picture out/sigma.png

Every sequence (and several places in one problem) is calibrated from several starts, 2 deg and
0.2 m off, against KITTI's calibration. Errors are the components of xi in T_estimate = exp(xi)
T_reference, about and along the camera's axes. The starts of one sequence share its frames, so
their errors are alike: the number of independent samples is that of the places.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.accuracy.scenes import GUESS_DEG, GUESS_M, Folders
from benchmarks.tables import ROOT, Table, add_record_option
from calibgraph import calibrate, perturb

NAMES = ("00", "05", "06", "07", "08", "06+07+08", "05+06+07+08")
PARTS = {"rotation": "deg", "translation": "cm"}
AXES = "xyz"
Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Component:
    """One component of one camera's result."""

    sequence: str
    camera: str
    part: str
    axis: str
    error: float
    sigma: float


def main() -> None:
    """Run cases, print the tables, draw the picture."""
    arguments = parse_options()
    cases = [
        Key("data", "sigma", name, seed)
        for seed in range(arguments.first, arguments.first + arguments.starts)
        for name in arguments.sequences
    ]
    work = partial(run_case, folders=Folders(arguments.realdata, None))
    records = ledger.records_of(arguments, cases, work)
    ledger.publish_cases("accuracy.sigma", report(records), records, record=arguments.record)
    if arguments.picture is not None:
        draw(list(components_of(records)), arguments.picture)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--starts", type=int, default=5, help="perturbed starts per sequence")
    parser.add_argument("--first", type=int, default=0, help="seed of the first start")
    parser.add_argument("--sequences", type=lambda text: text.split(","), default=NAMES)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--realdata", type=Path, default=ledger.REALDATA)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "sigma.jsonl")
    parser.add_argument("--summary", type=Path, help="print the tables of a file, run nothing")
    parser.add_argument("--picture", type=Path, help="draw errors against sigmas")
    add_record_option(parser)
    return parser.parse_args()


def run_case(case: Key, folders: Folders) -> Record:
    """Calibrate one sequence from one start."""
    data, truth = folders.load(case.data)
    guess = perturb(truth, rotation_deg=GUESS_DEG, translation_m=GUESS_M, seed=case.seed)
    return ledger.to_record(calibrate(data, guess), truth)


def components_of(records: list[Record]) -> Iterator[Component]:
    """All components of results that have an error bar."""
    for record in records:
        for name, camera in record.get("cameras", {}).items():
            if camera["sigma_deg"] is None:
                continue
            for part, unit in PARTS.items():
                both = zip(AXES, camera[f"xi_{unit}"], camera[f"sigma_{unit}"], strict=True)
                for axis, error, sigma in both:
                    yield Component(record["data"], name, part, axis, error, sigma)


COLUMNS = (
    "n", "rms error", "rms sigma", "ratio", "within 1 sigma", "within 2 sigma", "within 3 sigma"
)  # fmt: skip


def report(records: list[Record]) -> list[Table]:
    """Three tables: per sequence, camera and axis; per sequence; over all."""
    found = list(components_of(records))
    present = [name for name in NAMES if any(r["data"] == name for r in records)]
    axes: dict[tuple[str, ...], list[Component]] = {}
    for c in sorted(found, key=lambda c: (present.index(c.sequence), c.camera)):
        axes.setdefault((c.sequence, c.camera, f"{c.part} {c.axis} [{PARTS[c.part]}]"), []).append(
            c
        )
    sequences = {
        (name, f"{part} [{unit}]"): [
            c for c in found if c.part == part and name in (c.sequence, "all")
        ]
        for name in (*present, "all")
        for part, unit in PARTS.items()
    }
    normalised = [
        (name, *_normalised([r for r in records if name in (r["data"], "all")]))
        for name in (*present, "all")
    ]
    return [
        Table("Errors and sigmas per axis", ("data", "camera", "component", *COLUMNS),
              tuple((*name, *_row(chosen)) for name, chosen in axes.items())),
        Table("Errors and sigmas", ("data", "part", *COLUMNS),
              tuple((*name, *_row(chosen)) for name, chosen in sequences.items() if chosen)),
        Table("Squared error in its covariance, over 6 (1 is expected; its median 0.89)",
              ("data", "median", "largest", "with error bar", "without", "refused"),
              tuple(normalised)),
    ]  # fmt: skip


def _row(chosen: list[Component]) -> tuple[str, ...]:
    error, sigma = (np.array([getattr(c, key) for c in chosen]) for key in ("error", "sigma"))
    inside = [np.mean(np.abs(error) <= k * sigma) for k in (1, 2, 3)]
    return (
        str(len(chosen)), f"{_rms(error):.3f}", f"{_rms(sigma):.3f}",
        f"{_rms(error) / _rms(sigma):.2f}", *(f"{share:.0%}" for share in inside),
    )  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _normalised(records: list[Record]) -> tuple[str, ...]:
    cameras = [camera for r in records for camera in r.get("cameras", {}).values()]
    values = [c["normalised_squared"] for c in cameras if c["normalised_squared"] is not None]
    counts = len(values), len(cameras) - len(values), sum("cameras" not in r for r in records)
    both = (f"{np.median(values):.2f}", f"{max(values):.2f}") if values else ("", "")
    return *both, *map(str, counts)


def draw(found: list[Component], path: Path) -> None:
    """Draw |error| against sigma, a colour per sequence, with lines at one and two sigma."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.2), dpi=110, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2)
    names = [name for name in NAMES if any(c.sequence == name for c in found)]
    for panel, (part, unit) in zip(panels, PARTS.items(), strict=True):
        _draw_part(panel, [c for c in found if c.part == part], names)
        panel.set_xlabel(f"reported sigma [{unit}]")
        panel.set_ylabel(f"|error| [{unit}]")
        panel.set_title(f"{part}, one point per axis, camera and start")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _draw_part(panel: Any, found: list[Component], names: list[str]) -> None:
    from matplotlib import colormaps
    from matplotlib.ticker import LogLocator, NullFormatter

    colours = colormaps["tab10"]
    sigmas = np.array([c.sigma for c in found])
    low, high = sigmas.min() / 2, sigmas.max() * 2
    floor = low / 10  # smaller errors are drawn there
    for number, name in enumerate(names):
        own = [c for c in found if c.sequence == name]
        errors = [max(abs(c.error), floor) for c in own]
        panel.scatter(
            [c.sigma for c in own], errors, s=14, alpha=0.7, linewidth=0, color=colours(number),
            label=name,
        )  # fmt: skip
    ends = np.array([low, high])
    for factor, style in ((1, "-"), (2, "--")):
        panel.plot(ends, factor * ends, style, color="0.3", linewidth=1, label=f"{factor} sigma")
    panel.set(xscale="log", yscale="log", xlim=(low, high), ylim=(floor / 1.3, None))
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    panel.grid(color="0.92", linewidth=0.6)
    panel.set_axisbelow(True)


if __name__ == "__main__":
    main()

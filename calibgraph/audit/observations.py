"""The rows of a fleet as arrays: the measurement of each calibration, with its vehicle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError

Words = NDArray[np.str_]

NAMES = ("vehicle", "camera", "model", "batch")
_NO_COVARIATES = (*NAMES, "seconds", "probability_off", "date")
_NUMBERS = pa.types.is_floating, pa.types.is_integer
_UNKNOWN = 1e6
"""Variance [rad^2, m^2] of a camera without a usable result: it leaves the prior as it is."""


@dataclass(frozen=True, eq=False)
class Observations:
    """One row per vehicle and camera.

    Attributes:
        vehicle, camera, model, batch: (n,) names; model and batch are empty where not given.
        T_camera_lidar: (n, 4, 4).
        covariance: (n, 6, 6) of xi in T_camera_lidar = exp(xi) estimate (rotation [rad], then
            translation [m], in the camera's axes).
        measured: (n,) whether the row has a result with an error bar that did not FAIL.
        day: (n,) days since 1970; NaN where there is no date.
        covariates: per column of numbers of the manifest, (n,), NaN where there is none.
    """

    vehicle: Words
    camera: Words
    model: Words
    batch: Words
    T_camera_lidar: Array
    covariance: Array
    measured: NDArray[np.bool_]
    day: Array
    covariates: Mapping[str, Array]

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Some rows: a mask or an index array."""
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        covariates = {name: values[rows] for name, values in own.pop("covariates").items()}
        return Observations(**{k: v[rows] for k, v in own.items()}, covariates=covariates)


def observe(rows: pa.Table) -> Observations:
    """The rows of a fleet as arrays.

    Args:
        rows: as of ``read_rows``; columns of numbers beyond its own become covariates.

    Raises:
        CalibrationError: if a column is missing, or some poses are alignments and some mounts.
    """
    missing = [name for name in ("vehicle", "camera", "status", "T_camera_lidar", "covariance")
               if name not in rows.column_names]  # fmt: skip
    if missing:
        raise CalibrationError(
            f"the fleet's table has no column {missing[0]!r}, found "
            f"{', '.join(rows.column_names)}; give the folder that calibgraph fleet wrote"
        )
    done, vehicle = words(rows, "status") == "done", words(rows, "vehicle")
    of, first = np.unique(words(rows, "of")[done] == "mount", return_index=True)
    if len(of) > 1:
        alignment, mount = vehicle[done][first].tolist()
        raise CalibrationError(
            f"the rows of vehicle {mount!r} are of mounts, those of {alignment!r} of alignments, "
            "which are different quantities; calibrate all with one `of` in their settings"
        )
    T, placed = _fixed_size(rows, "T_camera_lidar", 16)
    covariance, bounded = _fixed_size(rows, "covariance", 36)
    measured = done & (words(rows, "verdict") != "FAIL") & placed & bounded
    measured &= words(rows, "camera") != ""
    unknown = np.eye(6) * _UNKNOWN
    numbers = [field.name for field in rows.schema if field.name not in _NO_COVARIATES
               and any(is_kind(field.type) for is_kind in _NUMBERS)]  # fmt: skip
    return Observations(
        **{name: words(rows, name) for name in NAMES},
        T_camera_lidar=np.where(measured[:, None, None], T.reshape(-1, 4, 4), np.eye(4)),
        covariance=np.where(measured[:, None, None], covariance.reshape(-1, 6, 6), unknown),
        measured=measured,
        day=days(rows),
        covariates={
            name: rows.column(name).cast(pa.float64()).fill_null(np.nan).to_numpy()
            for name in numbers
        },
    )


def newest_rows(rows: pa.Table) -> pa.Table:
    """The newest row of each vehicle and camera; of one date, or of none, the last."""
    index = np.argsort(np.nan_to_num(days(rows), nan=-np.inf), kind="stable")
    names = np.char.add(np.char.add(words(rows, "vehicle"), "\n"), words(rows, "camera"))[index]
    last = len(index) - 1 - np.unique(names[::-1], return_index=True)[1]
    return rows.take(pa.array(index[np.sort(last)]))


def words(rows: pa.Table, name: str) -> Words:
    """(n,) a column as text; empty where it is null or missing."""
    if name not in rows.column_names:
        return np.full(len(rows), "", dtype=np.str_)
    column = rows.column(name).cast(pa.string()).fill_null("")
    return np.asarray(column.to_numpy(), dtype=np.str_)


def days(rows: pa.Table) -> Array:
    """(n,) the column ``date`` in days since 1970; NaN where there is none."""
    if "date" not in rows.column_names:
        return np.full(len(rows), np.nan)
    try:
        stamps = rows.column("date").cast(pa.timestamp("us"))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise CalibrationError(
            f"the fleet's column 'date' holds what is no date ({error}); write 2026-03-01"
        ) from error
    stamp = stamps.to_numpy()
    microseconds = stamp.astype("datetime64[us]").astype(np.float64)
    return np.where(np.isnat(stamp), np.nan, microseconds / 86_400e6)


def _fixed_size(rows: pa.Table, name: str, size: int) -> tuple[Array, NDArray[np.bool_]]:
    """(n, size) values of a column of lists, zero where it is null; (n,) where it is not."""
    column = rows.column(name).combine_chunks()
    present = np.asarray(column.is_valid())
    values = np.zeros((len(rows), size))
    values[present] = np.asarray(column.flatten(), dtype=np.float64).reshape(-1, size)
    return values, present & np.isfinite(values).all(axis=1)

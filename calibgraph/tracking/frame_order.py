"""What an update takes: a frame after the last one, and what holds for it alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibgraph.errors import CorrespondenceError
from calibgraph.model.correspondences import Correspondences
from calibgraph.tracking.state import State

_LAST = 2**63 - 1  # other programs write it for "none"
_FINDINGS_PER_FRAME = ("systematic_rotation_rad", "systematic_translation_m")


def number_and_stamp(
    table: Correspondences, frame: int | None, state: State
) -> tuple[int, int | None]:
    """The number and the time stamp [ns] of the frame that a table holds.

    Args:
        table: the correspondences of one frame.
        frame: its number, which an empty table does not have.
        state: of the frames before.

    Raises:
        CorrespondenceError: if the table holds several frames, or one that is not after the last.
    """
    same = len(table) > 0 and (table.frame == table.frame[0]).all()
    numbers = table.frame[:1] if same else np.unique(table.frame)
    if len(numbers) > 1:
        raise CorrespondenceError(
            f"an update takes one frame, found {len(numbers)} (from {numbers[0]} to "
            f"{numbers[-1]}); give them one by one"
        )
    if frame is None and not len(numbers):
        raise CorrespondenceError("the table is empty; name which frame it is: frame=...")
    number = int(numbers[0]) if len(numbers) else int(frame or 0)
    if frame is not None and number != frame:
        raise CorrespondenceError(f"the table is of frame {number}, not {frame}", frame=number)
    stamp = int(table.stamp_ns.max()) if table.stamp_ns is not None and len(table) else None
    _require_after(state, number, stamp)
    return number, stamp


def _require_after(state: State, number: int, stamp: int | None) -> None:
    for what, value in (("number", number), ("stamp_ns", stamp)):
        if value == _LAST:
            raise CorrespondenceError(
                f"frame {number}: its {what} {value} is the largest there is, and no frame could "
                "follow; correct it: it is left out",
                frame=number,
            )
    last, last_stamp = state.frame, state.stamp_ns
    if last is not None and number <= last:
        what = "comes again" if number == last else f"comes after frame {last}"
        raise CorrespondenceError(
            f"frame {number} {what}; frames must be in the order of their numbers: it is left out",
            frame=number,
        )
    if stamp is not None and last_stamp is not None and stamp <= last_stamp:
        raise CorrespondenceError(
            f"frame {number}: its stamp_ns {stamp} is not after {last_stamp} of the frame "
            "before; correct the clock: it is left out",
            frame=number,
        )


def with_findings_per_frame(table: Correspondences) -> Correspondences:
    """The table with only those findings of its matcher that hold for a single frame."""
    kept = {k: float(table.metadata[k]) for k in _FINDINGS_PER_FRAME if k in table.metadata}
    return table if kept == table.metadata else replace(table, metadata=kept)

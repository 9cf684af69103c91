"""Recalibration while the robot drives: frames in, estimates with error bars and events out."""

from calibgraph.tracking.assessment import Update
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.events import Event
from calibgraph.tracking.frames import StreamFrame
from calibgraph.tracking.tracker import IncrementalCalibrator, warm_up_tracker

__all__ = [
    "DurableCalibrator",
    "Event",
    "IncrementalCalibrator",
    "StreamFrame",
    "Update",
    "warm_up_tracker",
]

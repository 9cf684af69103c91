"""Recalibration while the robot drives: frames in, estimates with error bars and events out."""

from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.events import Event
from calibgraph.tracking.frame_group import update_all
from calibgraph.tracking.preload import warm_up_tracker
from calibgraph.tracking.stream_tables import StreamFrame
from calibgraph.tracking.tracker import IncrementalCalibrator
from calibgraph.tracking.update import Update

__all__ = [
    "DurableCalibrator",
    "Event",
    "IncrementalCalibrator",
    "StreamFrame",
    "Update",
    "update_all",
    "warm_up_tracker",
]

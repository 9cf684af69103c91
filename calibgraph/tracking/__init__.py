"""Recalibration while the robot drives: frames in, estimates with error bars and events out."""

from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.events import Event
from calibgraph.tracking.tracker import IncrementalCalibrator
from calibgraph.tracking.update import Update
from calibgraph.tracking.warm_up import warm_up

__all__ = ["DurableCalibrator", "Event", "IncrementalCalibrator", "Update", "warm_up"]

from .frames import relocate_frames
from .html import write_report

__all__ = ["relocate_frames", "write_report"]

"""Joint multi-camera LiDAR extrinsic calibration as a factor graph.

``T_a_b`` maps coordinates in b to coordinates in a: ``p_camera = T_camera_lidar * p_lidar``. The
public names are listed in ``__init__.pyi``; each is imported on first use.
"""

import logging

import lazy_loader

logging.getLogger(__name__).addHandler(logging.NullHandler())  # nothing is printed unless asked for

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

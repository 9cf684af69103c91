"""Sensors beside the cameras: LiDARs relative to each other, and the vehicle that carries them."""

"""A rig for a calibration to begin with, from words, or from frames of a URDF."""

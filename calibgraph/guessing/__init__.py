"""A rig for a calibration to begin with, from words, from frames of a URDF, or from nothing."""

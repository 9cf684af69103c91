"""Calibrations by a server, from Python."""

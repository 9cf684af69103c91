"""Calibrations over HTTP: jobs, trackers and pages for people."""

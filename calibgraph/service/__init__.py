"""Calibrations over HTTP: jobs, trackers and pages for people.

Routes and what they call raise ``Problem`` to refuse a request, with its status and one line.
"""

"""Calibrations over HTTP; routes refuse a request by a ``Problem``, with its status and a line."""

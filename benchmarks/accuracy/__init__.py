"""Errors against a reference, error bars and verdicts."""

"""Benchmarks: run from the checkout, as `python -m benchmarks.speed.gate`."""

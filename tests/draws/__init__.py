"""Worlds with a known truth, drawn for tests and benchmarks."""

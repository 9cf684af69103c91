"""Simulated rigs with known truth: correspondences with a matcher's errors, and sensor data."""

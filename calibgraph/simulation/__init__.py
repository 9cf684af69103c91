"""Simulated rigs with a known truth: sensor data, and correspondences with a matcher's errors."""

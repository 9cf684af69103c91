"""Scenes and lens errors for experiments; the package renders streets alone."""

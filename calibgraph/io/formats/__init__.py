"""Calibrations in the formats of others: one module per format or small group, out and in."""

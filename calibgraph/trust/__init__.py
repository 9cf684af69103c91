"""Can the result be used? A list of checks per camera; start at ``assess``."""

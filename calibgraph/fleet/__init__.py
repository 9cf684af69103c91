"""Many vehicles: what their calibrations have in common, and which of them deviate."""

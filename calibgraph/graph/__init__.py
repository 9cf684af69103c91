"""What is minimized: small GTSAM graphs, joined to the objective and to the error model."""

"""One solve over a table that no machine holds: its files stay with workers, their sums travel."""

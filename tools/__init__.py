"""What makes numbers that ship with the package, and pins results while code changes."""

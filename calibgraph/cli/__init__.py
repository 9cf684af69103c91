"""The command line: each command loads, calls one library function, and prints."""

"""The report: a result on one HTML page that needs no network."""

"""Files in: datasets, clouds, rigs, correspondence tables, results. One module per format."""

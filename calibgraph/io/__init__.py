"""Files in: datasets, clouds, rigs, correspondence tables, results. One module per format.

All readers raise ``FileError``, or ``DatasetError`` for what several files contradict: one line with
the place, the value found and the remedy. A docstring names an error only where more is to be said.
"""

"""Files in: datasets, clouds, rigs, correspondence tables, results. One module per format.

All readers raise ``FileError``, or ``DatasetError`` where several files contradict each other: one
line with the place, the value found and the remedy. Docstrings name an error where it is special.
"""

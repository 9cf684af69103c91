"""Files in: ``dataset`` and ``dataset_folders``, ``clouds``, ``rigs``, tables, results.

``bags`` reads ROS bags, ``formats`` files of other programs, which it writes too.

All readers raise ``FileError``, or ``DatasetError`` where several files contradict each other: one
line with the place, the value found and the remedy. Docstrings name an error where it is special.
"""

"""The report: a result on one HTML page that needs no network."""

import lazy_loader

# A process that draws diagrams does without the modules that read results.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Calibrations by a server, from Python; needs the extra ``client``."""

from calibgraph.client.answers import RemoteJob, ServerError
from calibgraph.client.client import Client

__all__ = ["Client", "RemoteJob", "ServerError"]

"""Calibrations by a server, from Python; needs the extra ``client``."""

from calibgraph.client.client import Client, RemoteJob, ServerError

__all__ = ["Client", "RemoteJob", "ServerError"]

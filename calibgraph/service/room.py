"""Room for bodies that arrive, reserved before they are taken: no tenant takes another's."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from fastapi import Request

from calibgraph.service.problems import Problem

_STEP = 2**20
"""Room for a body without a length is reserved in such steps, as it arrives."""
_RETRY_AFTER = {"Retry-After": "30"}


@dataclass
class Held:
    """Room that is reserved for a body, and the part of it that has arrived."""

    tenant: str
    bytes: int = 0
    arrived: int = 0


class Room:
    """Room that all tenants share. Bodies of one tenant take half of what it could have at most.

    Args:
        free_bytes: how much is free at present, besides what has arrived.
        least_bytes: that stay free.
        status: of the answer if there is no room.
    """

    def __init__(self, free_bytes: Callable[[], int], least_bytes: int, status: int) -> None:
        self._free_bytes, self._least, self._status = free_bytes, least_bytes, status
        self._held: list[Held] = []

    @property
    def arrived_bytes(self) -> int:
        """Of all bodies that arrive at present."""
        return sum(held.arrived for held in self._held)

    @contextmanager
    def hold(
        self, request: Request, tenant: str, most_bytes: int
    ) -> Iterator[Callable[[int], None]]:
        """Reserve room for the body of a request, by its Content-Length if it has one.

        Returns:
            A function to call with the size of each piece that arrives.

        Raises:
            Problem: if the body is or becomes larger than ``most_bytes``, or there is no room.
        """
        held = Held(tenant)

        def arrive(size: int) -> None:
            held.arrived += size
            if held.arrived > most_bytes:
                raise _too_large(most_bytes)
            if held.arrived > held.bytes:
                self._grow(held, max(size, _STEP))

        length = int(request.headers.get("content-length", "0"))
        if length > most_bytes:
            raise _too_large(most_bytes)
        self._grow(held, length)
        self._held.append(held)
        try:
            yield arrive
        finally:
            self._held.remove(held)

    async def read(self, request: Request, tenant: str, most_bytes: int) -> bytes:
        """The body of a request, which is kept in memory; see :meth:`hold`."""
        body = bytearray()
        with self.hold(request, tenant, most_bytes) as arrive:
            async for piece in request.stream():
                arrive(len(piece))
                body += piece
        return bytes(body)

    def _grow(self, held: Held, more: int) -> None:
        """Reserve further bytes for a body."""
        to_come = sum(max(0, each.bytes - each.arrived) for each in self._held)
        own = sum(each.bytes for each in self._held if each.tenant == held.tenant)
        left = self._free_bytes() - self._least - to_come
        if own + more > (left + own) // 2:
            most = max(0, (left - own) // 2)
            raise Problem(
                self._status,
                f"the body needs room for {more} bytes, and {most} are left; try again later",
                _RETRY_AFTER,
            )
        held.bytes += more


def _too_large(most_bytes: int) -> Problem:
    return Problem(413, f"the body is larger than {most_bytes} bytes; send less")

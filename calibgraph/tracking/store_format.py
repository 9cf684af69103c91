"""The bytes of a tracker's snapshots and journals, each with its checksums.

All numbers are big-endian::

    snapshot  magic line, S, generation, chain, length of state, SHA-256 of all else, state
    journal   magic line, J, generation, chain, CRC-32 of all before, records
    record    length of input, SHA-256 of the last digest and the input, CRC-32 of these two, input

The chain is the digest of the last input before. By it a journal is recognised that does not
continue what precedes it, because inputs in between were lost.
"""

from __future__ import annotations

import hashlib
import re
import struct
import zlib
from dataclasses import dataclass
from typing import Any

STORE_FORMAT = "calibgraph-tracker/1"
DIGEST_BYTES = 32
HEAD_BYTES = 64
"""Enough of a file to tell its format."""

_MAGIC = f"{STORE_FORMAT}\n".encode()
_ANY_VERSION = re.compile(rb"calibgraph-tracker/([0-9]{1,9})\n")
_SNAPSHOT_HEAD = struct.Struct(">cQ32sQ")
_JOURNAL_HEAD = struct.Struct(">cQ32s")
_RECORD_HEAD = struct.Struct(">Q32s")
_CHECK_BYTES = 4


@dataclass(frozen=True)
class Snapshot:
    """A state, and the chain that the journal after it begins with; None at the very start."""

    generation: int
    chain: bytes | None
    state: bytes | None


@dataclass(frozen=True)
class Journal:
    """The good part of a journal, its first ``length`` bytes, and what is wrong behind it.

    Its chain goes from ``start``, before the first record, to ``end``, after the last.
    """

    start: bytes
    end: bytes
    records: tuple[bytes, ...]
    length: int
    fault: DamageError | None


class DamageError(Exception):
    """Bytes that are not what was written."""


class TornError(DamageError):
    """A file that ends inside a record, as a crash during ``append`` leaves it."""


def other_format(head: bytes) -> str | None:
    """What a file's first ``HEAD_BYTES`` name, if that is another version of the format."""
    match = _ANY_VERSION.match(head)
    return match[0].decode().strip() if match and match[0] != _MAGIC else None


def encode_snapshot(generation: int, chain: bytes, state: bytes) -> bytes:
    """The bytes of a snapshot file."""
    head = _MAGIC + _SNAPSHOT_HEAD.pack(b"S", generation, chain, len(state))
    return head + hashlib.sha256(head + state).digest() + state


def decode_snapshot(data: bytes, generation: int) -> Snapshot:
    """What a snapshot file holds.

    Raises:
        DamageError: if that is not what was written as this generation.
    """
    kind, number, chain, length = _unpack_head(_SNAPSHOT_HEAD, data, DIGEST_BYTES)
    at = len(_MAGIC) + _SNAPSHOT_HEAD.size
    digest, state = data[at : at + DIGEST_BYTES], data[at + DIGEST_BYTES :]
    if len(state) != length:
        raise DamageError(f"has {len(state)} bytes of state, expected {length}")
    if digest != hashlib.sha256(data[:at] + state).digest():
        raise DamageError("does not match its checksum")
    if (kind, number) != (b"S", generation):
        raise DamageError(f"holds generation {number}, expected snapshot {generation}")
    return Snapshot(generation, chain, state)


def encode_journal_head(generation: int, chain: bytes) -> bytes:
    """The bytes of a journal file before its first record."""
    return _with_check(_MAGIC + _JOURNAL_HEAD.pack(b"J", generation, chain))


def _decode_journal_head(data: bytes, generation: int) -> tuple[bytes, int]:
    """The digest before the first record, and where that begins."""
    kind, number, chain = _unpack_head(_JOURNAL_HEAD, data, _CHECK_BYTES)
    length = len(_MAGIC) + _JOURNAL_HEAD.size + _CHECK_BYTES
    if not _check_holds(data[:length]):
        raise DamageError("its head does not match its checksum")
    if (kind, number) != (b"J", generation):
        raise DamageError(f"holds generation {number}, expected journal {generation}")
    return chain, length


def decode_journal(data: bytes, generation: int) -> Journal:
    """What a journal file holds, up to the first record that is not good.

    Raises:
        DamageError: if its head is not what was written as this generation.
    """
    start, at = _decode_journal_head(data, generation)
    digest, records = start, list[bytes]()
    try:
        while at < len(data):
            record, digest, at = _decode_record(data, at, digest)
            records.append(record)
    except DamageError as fault:
        return Journal(start, digest, tuple(records), at, fault)
    return Journal(start, digest, tuple(records), at, None)


def encode_record(record: bytes, digest: bytes) -> tuple[bytes, bytes]:
    """The bytes of a record after the one with that digest, and its own digest."""
    digest = hashlib.sha256(digest + record).digest()
    return _with_check(_RECORD_HEAD.pack(len(record), digest)) + record, digest


def _decode_record(data: bytes, at: int, digest: bytes) -> tuple[bytes, bytes, int]:
    """The record at ``at``, the digest after it, and where the next one begins.

    The length has a checksum of its own: a wrong one must not pass for a file cut short.
    """
    begin = at + _RECORD_HEAD.size + _CHECK_BYTES
    head = data[at:begin]
    if len(data) < begin:
        raise TornError("is cut short")
    if not _check_holds(head):
        # A file system may have lengthened the file, but not written it, when power failed.
        kind = DamageError if any(data[at:]) else TornError
        raise kind("has a head that does not match its checksum")
    length, expected = _RECORD_HEAD.unpack_from(head)
    record = data[begin : begin + length]
    if len(record) < length:
        raise TornError("is cut short")
    if hashlib.sha256(digest + record).digest() != expected:
        raise DamageError("does not match its checksum")
    return record, expected, begin + length


def _unpack_head(head: struct.Struct, data: bytes, check_bytes: int) -> tuple[Any, ...]:
    if not data.startswith(_MAGIC):
        raise DamageError(f"does not begin with the line {STORE_FORMAT}")
    if len(data) < len(_MAGIC) + head.size + check_bytes:
        raise DamageError(f"is cut short to {len(data)} bytes")
    return head.unpack_from(data, len(_MAGIC))


def _with_check(data: bytes) -> bytes:
    return data + zlib.crc32(data).to_bytes(_CHECK_BYTES)


def _check_holds(data: bytes) -> bool:
    return _with_check(data[:-_CHECK_BYTES]) == data

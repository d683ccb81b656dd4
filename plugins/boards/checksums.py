"""Checksums of frames, by the names that profiles use.

Names and parameters of the CRCs are those of the catalogue by G. Cook
(reveng.sourceforge.io/crc-catalogue): crc8 is CRC-8/SMBUS, crc8_maxim CRC-8/MAXIM-DOW, crc16
CRC-16/IBM-3740 (also called CCITT-FALSE), crc16_xmodem, crc16_modbus, crc32 CRC-32/ISO-HDLC (zlib).
"""

from __future__ import annotations

import functools
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass
from zlib import crc32


@dataclass(frozen=True)
class Checksum:
    """A checksum: its size in bytes (0..4), and the function of the bytes that it covers."""

    n_bytes: int
    compute: Callable[[bytes], int]

    @property
    def is_strong(self) -> bool:
        """True for a CRC of 16 bits or more: one frame alone can be believed."""
        return self.n_bytes >= 2 and self.compute is not _sum16


def _none(data: bytes) -> int:
    return 0


def _sum8(data: bytes) -> int:
    return sum(data) & 0xFF


def _sum16(data: bytes) -> int:
    return sum(data) & 0xFFFF


def _xor8(data: bytes) -> int:
    # The exclusive or of all bytes, by halves: integers are as long as is needed.
    value, n_bytes = int.from_bytes(data, "little"), len(data)
    while n_bytes > 1:
        half = (n_bytes + 1) // 2
        value = (value >> 8 * half) ^ (value & ((1 << 8 * half) - 1))
        n_bytes = half
    return value


def _crc16(data: bytes) -> int:
    return crc_hqx(data, 0xFFFF)


def _crc16_xmodem(data: bytes) -> int:
    return crc_hqx(data, 0)


def _crc8(data: bytes) -> int:
    table, value = _table(0x07, 8, False), 0
    for byte in data:
        value = table[value ^ byte]
    return value


def _crc8_maxim(data: bytes) -> int:
    table, value = _table(0x8C, 8, True), 0
    for byte in data:
        value = table[value ^ byte]
    return value


def _crc16_modbus(data: bytes) -> int:
    table, value = _table(0xA001, 16, True), 0xFFFF
    for byte in data:
        value = table[(value ^ byte) & 0xFF] ^ (value >> 8)
    return value


@functools.cache
def _table(polynomial: int, n_bits: int, reflected: bool) -> tuple[int, ...]:
    """Remainders of all bytes; `polynomial` is in the order of bits that `reflected` states."""
    top, mask, table = 1 << (n_bits - 1), (1 << n_bits) - 1, []
    for byte in range(256):
        value = byte if reflected else byte << (n_bits - 8)
        for _ in range(8):
            if reflected:
                value = (value >> 1) ^ (polynomial if value & 1 else 0)
            else:
                value = ((value << 1) & mask) ^ (polynomial if value & top else 0)
        table.append(value)
    return tuple(table)


CHECKSUMS = {
    "none": Checksum(0, _none),
    "sum8": Checksum(1, _sum8),
    "sum16": Checksum(2, _sum16),
    "xor8": Checksum(1, _xor8),
    "crc8": Checksum(1, _crc8),
    "crc8_maxim": Checksum(1, _crc8_maxim),
    "crc16": Checksum(2, _crc16),
    "crc16_xmodem": Checksum(2, _crc16_xmodem),
    "crc16_modbus": Checksum(2, _crc16_modbus),
    "crc32": Checksum(4, crc32),
}

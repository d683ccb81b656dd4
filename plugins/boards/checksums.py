"""Checksums of frames, by the names that profiles use.

Names and parameters of the CRCs are those of the catalogue by G. Cook
(reveng.sourceforge.io/crc-catalogue): crc8 is CRC-8/SMBUS, crc8_maxim CRC-8/MAXIM-DOW, crc16
CRC-16/IBM-3740 (also called CCITT-FALSE), crc16_xmodem, crc16_modbus, crc32 CRC-32/ISO-HDLC (zlib).
"""

from __future__ import annotations

import functools
import operator
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass
from zlib import crc32

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Checksum:
    """A checksum: its size in bytes (0..4), and the function of the bytes that it covers.
    `is_strong` is True for a CRC of 16 bits or more: one frame alone can be believed.
    """

    n_bytes: int
    compute: Callable[[bytes], int]
    is_strong: bool = False


LEAST = 64
"""Bytes from which on a CRC is computed for all at once; chosen: arrays cost more before."""
BLOCK = 2048
"""Bytes that a table of `_crc16` covers, which has 512 times as many; chosen: most frames."""


def _crc16(polynomial: int, start: int) -> Callable[[bytes], int]:
    """A reflected CRC of 16 bits. It is linear over GF(2): the sum of what each byte contributes at
    its distance from the end, after the state has been added to the first two bytes.
    """
    by_byte = _crc(polynomial, start)

    @functools.cache
    def contributions() -> npt.NDArray[np.uint16]:
        of_bytes = _crc(polynomial)
        last = np.array([of_bytes(bytes([value])) for value in range(256)], np.uint16)
        found = np.empty((BLOCK, 256), np.uint16)
        found[-1] = last
        for place in range(BLOCK - 2, -1, -1):
            found[place] = last[found[place + 1] & 0xFF] ^ (found[place + 1] >> 8)
        return found

    def compute(data: bytes) -> int:
        if len(data) < LEAST:
            return by_byte(data)
        value, rest = start, np.frombuffer(data, np.uint8)
        while len(rest):
            # No block of a single byte: the state has two.
            n = min(BLOCK, len(rest)) - (len(rest) == BLOCK + 1)
            block = rest[:n].copy()
            block[:2] ^= np.array([value & 0xFF, value >> 8], np.uint8)
            at = np.arange(BLOCK - n, BLOCK)
            value = int(np.bitwise_xor.reduce(contributions()[at, block]))
            rest = rest[n:]
        return value

    return compute


def _crc(polynomial: int, start: int = 0, reflected: bool = True) -> Callable[[bytes], int]:
    """A reflected CRC, or one of 8 bits, by a table of the remainders of all bytes; `polynomial` is
    in the order of bits that `reflected` states, the highest of an unreflected one included.
    """
    table = []
    for value in range(256):
        for _ in range(8):
            if reflected:
                value = (value >> 1) ^ (polynomial if value & 1 else 0)
            else:
                value = (value << 1) ^ (polynomial if value & 0x80 else 0)
        table.append(value)

    def compute(data: bytes) -> int:
        value = start
        for byte in data:
            value = table[(value ^ byte) & 0xFF] ^ (value >> 8)
        return value

    return compute


CHECKSUMS = {
    "none": Checksum(0, lambda data: 0),
    "sum8": Checksum(1, lambda data: sum(data) & 0xFF),
    "sum16": Checksum(2, lambda data: sum(data) & 0xFFFF),
    "xor8": Checksum(1, lambda data: functools.reduce(operator.xor, data, 0)),
    "crc8": Checksum(1, _crc(0x107, reflected=False)),
    "crc8_maxim": Checksum(1, _crc(0x8C)),
    "crc16": Checksum(2, lambda data: crc_hqx(data, 0xFFFF), True),
    "crc16_xmodem": Checksum(2, lambda data: crc_hqx(data, 0), True),
    "crc16_modbus": Checksum(2, _crc16(0xA001, 0xFFFF), True),
    "crc32": Checksum(4, crc32, True),
}

"""Checksums of frames, by the names that profiles use.

Names and parameters of the CRCs are those of the catalogue by G. Cook
(reveng.sourceforge.io/crc-catalogue): crc8 is CRC-8/SMBUS, crc8_maxim CRC-8/MAXIM-DOW, crc16
CRC-16/IBM-3740 (also called CCITT-FALSE), crc16_xmodem, crc16_modbus, crc32 CRC-32/ISO-HDLC (zlib).
"""

import functools
import operator
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass
from zlib import crc32


@dataclass(frozen=True)
class Checksum:
    """A checksum: its size in bytes (0..4), and the function of the bytes that it covers.
    `is_strong` is True for a CRC of 16 bits or more: one frame alone can be believed.
    """

    n_bytes: int
    compute: Callable[[bytes], int]
    is_strong: bool = False


def _crc(
    polynomial: int, initial: int = 0, reflected: bool = True
) -> Callable[[bytes], int]:
    """A reflected CRC of up to 16 bits, or one of 8, by a table of the remainders of all bytes;
    `polynomial` is in the order of bits that `reflected` states, the highest of an unreflected one
    included.
    """
    table = []
    for value in range(256):
        for _ in range(8):
            if reflected:
                is_set = value & 1
                value >>= 1
            else:
                is_set = value & 0x80
                value <<= 1
            if is_set:
                value ^= polynomial
        table.append(value)

    def compute(data: bytes) -> int:
        value = initial
        for byte in data:
            # Of a CRC of 8 bits, nothing remains behind the byte.
            value = (value >> 8) ^ table[(value ^ byte) & 0xFF]
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
    "crc16_modbus": Checksum(2, _crc(0xA001, 0xFFFF), True),
    "crc32": Checksum(4, crc32, True),
}

"""Frames in pieces: packets of boards, chunks of CAN."""

import random
import struct
from binascii import crc_hqx

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.plugins.boards.can_port import Assembler, Chunks, chunks_of
from sparseskin.plugins.boards.framing import Counts, Frame, FrameParser, Framing
from sparseskin.plugins.boards.readings import Pieces
from sparseskin.plugins.boards.settings import CanSettings
from sparseskin.plugins.boards.source import describe_board

N = 10
MODULUS = 1 << 8


def cut(frames, size, numbered):
    """Pieces of `size` readings of a byte each of frames that follow one another."""
    stream = b"".join(frames)
    starts = range(0, len(stream) - size + 1, size)
    return [
        Frame(
            stream[at : at + size], k % MODULUS if numbered else None, 0, first=at % N
        )
        for k, at in enumerate(starts)
    ]


@given(
    n=st.integers(1, 40), size=st.integers(1, N), numbered=st.booleans(), data=st.data()
)
def test_frames_are_whole_or_counted_whatever_pieces_are_lost(n, size, numbered, data):
    frames = [bytes([k]) * N for k in range(n)]
    sent = cut(frames, size, numbered)
    # Without numbers a loss of whole turns cannot be noticed.
    most = len(sent) if numbered else 1
    lost = data.draw(st.sets(st.integers(0, len(sent)), max_size=most))
    came = [piece for k, piece in enumerate(sent) if k not in lost]
    counts = Counts(frames=len(came))
    pieces = Pieces(N, 1, MODULUS if numbered else 0, counts)
    found = [
        frame.payload for piece in came if (frame := pieces.add(piece)) is not None
    ]
    whole = [
        frame
        for k, frame in enumerate(frames)
        if (k + 1) * N <= len(sent) * size
        and not lost & {*range(k * N // size, -(-(k + 1) * N // size))}
    ]
    assert found == whole
    pieces.reset()
    assert counts.frames == len(found)
    assert counts.dropped_bytes == len(came) * size - len(found) * N


def board(query):
    return describe_board(f"serial:/dev/ttyUSB0?{query}")


def read(found, stream):
    parser = FrameParser(found.framing)
    pieces = [stream[k : k + 997] for k in range(0, len(stream), 997)]
    return [frame for piece in pieces for frame in parser.feed(piece)], parser.counts


def test_packets_of_a_wiresens_board_become_frames_whose_readings_rise_with_the_press():
    found = board("profile=wiresens")
    readings = np.random.default_rng(0).integers(0, 4096, (4, 32, 32)).astype("<u2")
    values = readings.ravel()
    stream = b"Initializing Toolkit\r\n"
    for k in range(len(values) // 120):
        packet = (
            struct.pack("<bH", 1, 120 * k % 1024)
            + values[120 * k : 120 * (k + 1)].tobytes()
        )
        stream += packet + struct.pack("<I", k) + b"wr"
    frames, counts = read(found, stream)
    # The first packet has no end before it.
    assert counts.frames == len(values) // 120 - 1
    assert counts.bad_frames == 0
    pieces = Pieces(1024, 2, 1 << 32, counts)
    whole = [frame for one in frames if (frame := pieces.add(one)) is not None]
    assert counts.frames == len(whole) == 2
    for frame, expected in zip(whole, readings[1:3], strict=True):
        np.testing.assert_array_equal(found.decode(frame.payload), 4095.0 - expected)
    assert found.skin.f_max == 4095
    assert found.skin.shape == (32, 32)


def taxelscan(readings, number, n_contacts, rows=16):
    """A frame of version 2, as emitBinV2 packs it."""
    payload = readings + random.Random(number).randbytes(20 * n_contacts + 28)
    head = struct.pack("<2sBBHBBH", b"FT", 2, 7, number, rows, 32, len(payload))
    head += struct.pack("<IHHBB", 12500, 876, 0, n_contacts, 0)
    return head + struct.pack(f"<H{len(payload)}sH", crc_hqx(head, 0xFFFF), payload,
                              crc_hqx(payload, 0xFFFF))  # fmt: skip


def test_frames_of_a_taxelscan_board_have_any_number_of_contacts():
    found = board("profile=taxelscan")
    readings = np.random.default_rng(0).integers(-50, 4096, (6, 16, 32)).astype("<i2")
    contacts = [0, 3, 32, 1, 0, 7]
    sent = [
        taxelscan(one.tobytes(), k, n)
        for k, (one, n) in enumerate(zip(readings, contacts, strict=True))
    ]
    # A frame of 16 x 16 with as many contacts is as long, and another skin.
    other = taxelscan(bytes(512), 9, 26, rows=8)
    wrong = sent[2][:700] + b"\x00" + sent[2][701:]
    long = sent[3][:8] + b"\xff\xff" + sent[3][10:]
    stream = (
        b"# TaxelScan ready\r\n"
        + sent[0]
        + sent[1]
        + wrong
        + other
        + long
        + sent[4]
        + sent[5]
    )
    frames, counts = read(found, stream)
    assert [frame.sequence for frame in frames] == [0, 1, 4, 5]
    assert counts.missing_frames == 2
    for frame in frames:
        np.testing.assert_array_equal(
            found.decode(frame.payload), readings[frame.sequence or 0]
        )


BY_ID = Chunks((0x10, 0x11, 0x12), 3, 20, 8, 0, 0)
COUNTED = Chunks((0x10, 0x11, 0x12, 0x13), 4, 20, 6, 0, 1)
INDEXED = Chunks((0x10,), 4, 20, 6, 1, 1)

frames = st.lists(
    st.binary(min_size=20, max_size=20), min_size=1, max_size=8, unique=True
)


def spread(chunks, frame, counter):
    """CAN frames of a frame, as a board sends them."""
    sent = []
    for k in range(chunks.n_chunks):
        head = bytes([k] if chunks.index_bytes else [])
        head += bytes([counter % 256] if chunks.counter_bytes else [])
        data = frame[k * chunks.chunk_bytes : (k + 1) * chunks.chunk_bytes]
        sent.append((chunks.ids[k if len(chunks.ids) > 1 else 0], head + data))
    return sent


def assembled(chunks, sent):
    counts = Counts()
    assembler = Assembler(chunks, counts)
    found = [assembler.add(*one) for one in sent]
    return [frame for frame in found if frame is not None], counts


@given(frames=frames, chunks=st.sampled_from([BY_ID, COUNTED, INDEXED]))
def test_all_frames_are_found(frames, chunks):
    sent = [one for k, frame in enumerate(frames) for one in spread(chunks, frame, k)]
    assert assembled(chunks, sent) == (frames, Counts())


@given(frames=frames, chunks=st.sampled_from([COUNTED, INDEXED]), data=st.data())
def test_with_a_counter_chunks_may_be_lost_repeated_or_swapped_within_a_frame(
    frames, chunks, data
):
    sent = []
    whole = []
    for k, frame in enumerate(frames):
        parts = spread(chunks, frame, k)
        kept = data.draw(
            st.lists(st.sampled_from(parts), unique=True, max_size=len(parts))
        )
        sent += kept
        whole += [frame] if len(kept) == len(parts) else []
    found, counts = assembled(chunks, sent)
    assert found == whole
    n_cut = len(sent) - len(whole) * chunks.n_chunks
    assert bool(counts.dropped_bytes) <= bool(n_cut)


@given(frames=frames, lost=st.integers(0, 1), at=st.integers(0, 30))
def test_without_a_counter_a_lost_chunk_costs_its_frame_alone(frames, lost, at):
    sent = [one for k, frame in enumerate(frames) for one in spread(BY_ID, frame, k)]
    at %= len(sent)
    found, counts = assembled(BY_ID, sent[:at] + sent[at + lost :])
    assert found == [f for k, f in enumerate(frames) if not (lost and k == at // 3)]
    if lost:
        rest = 20 - BY_ID.length_of(at % 3)
        is_last = at // 3 == len(frames) - 1 and at % 3 == 2  # it may yet come
        assert counts.dropped_bytes == (0 if is_last else rest)


def test_other_ids_and_wild_data_are_no_chunk_and_padding_is_left_out():
    wild = [
        (0x7FF, bytes(8)),
        *((0x10, data) for data in (b"", b"\0", b"\xff" * 8, bytes(3))),
    ]
    assert assembled(INDEXED, wild) == ([], Counts(dropped_bytes=12))
    chunks = chunks_of(CanSettings(ids="0x10-0x11", fd=True), Framing(70))
    assert chunks.n_chunks == 2
    assert chunks.length_of(0) == 64
    assert chunks.length_of(1) == 6
    frame = bytes(range(70))
    sent = [(0x10, frame[:64]), (0x11, frame[64:] + bytes(2))]
    assert assembled(chunks, sent) == ([frame], Counts())

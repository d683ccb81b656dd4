"""Frames of a skin spread over CAN frames: put together, or counted as incomplete."""

from hypothesis import given
from hypothesis import strategies as st

from sparseskin.plugins.boards.can_port import Assembler, Chunks, chunks_of
from sparseskin.plugins.boards.framing import Counts, Framing
from sparseskin.plugins.boards.settings import CanSettings

BY_ID = Chunks((0x10, 0x11, 0x12), 3, 20, 8, 0, 0)
COUNTED = Chunks((0x10, 0x11, 0x12, 0x13), 4, 20, 6, 0, 1)
INDEXED = Chunks((0x10,), 4, 20, 6, 1, 1)

frames = st.lists(st.binary(min_size=20, max_size=20), min_size=1, max_size=8, unique=True)


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
def test_with_a_counter_chunks_may_be_lost_repeated_or_swapped_within_a_frame(frames, chunks, data):
    sent, whole = [], []
    for k, frame in enumerate(frames):
        parts = spread(chunks, frame, k)
        kept = data.draw(st.lists(st.sampled_from(parts), unique=True, max_size=len(parts)))
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


def test_other_ids_and_short_or_wild_data_are_no_chunk():
    wild = [(0x7FF, bytes(8)), *((0x10, data) for data in (b"", b"\0", b"\xff" * 8, bytes(3)))]
    assert assembled(INDEXED, wild) == ([], Counts(dropped_bytes=12))


def test_padding_of_can_fd_is_left_out():
    framing = Framing(70)
    chunks = chunks_of(CanSettings(ids="0x10-0x11", fd=True), framing)
    assert (chunks.n_chunks, chunks.length_of(0), chunks.length_of(1)) == (2, 64, 6)
    frame = bytes(range(70))
    sent = [(0x10, frame[:64]), (0x11, frame[64:] + bytes(2))]
    assert assembled(chunks, sent) == ([frame], Counts())

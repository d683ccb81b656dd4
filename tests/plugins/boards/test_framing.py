"""Frames in a stream of bytes: found whatever is lost, extra or wrong, and however it is cut."""

import random
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin.plugins.boards.checksums import CHECKSUMS
from sparseskin.plugins.boards.framing import (
    MAX_CHECKS,
    Counts,
    Frame,
    FrameParser,
    Framing,
    PacketParser,
    Sequence,
)

few = settings(max_examples=25)
MARK = b"\xaa\x55"
PLAIN = Framing(12, start=MARK)
WITH_CRC = Framing(12, start=MARK, sequence_bytes=2, checksum="crc32")


def parsed(framing, pieces):
    parser = FrameParser(framing)
    return [frame for piece in pieces for frame in parser.feed(piece)], parser


def cut(data, cuts):
    """Bytes in pieces, cut at some places."""
    ends = sorted({min(one, len(data)) for one in cuts} | {0, len(data)})
    return [data[a:b] for a, b in pairwise(ends)]


def is_subsequence(part, whole):
    left = iter(whole)
    return all(one in left for one in part)


cuts = st.lists(st.integers(0, 400), max_size=12)
payloads = st.lists(st.binary(min_size=12, max_size=12), min_size=1, max_size=12)
#: Readings that never hold the first start byte.
plain_payloads = st.lists(
    st.lists(st.integers(0, 0xA9), min_size=12, max_size=12).map(bytes),
    min_size=1,
    max_size=12,
)


def test_a_checksum_of_the_digits_is_that_of_the_catalogue():
    # The check values of the catalogue of CRCs: of the ASCII digits 1 to 9.
    assert {name: one.compute(b"123456789") for name, one in CHECKSUMS.items()} == {
        "crc8": 0xF4,
        "crc8_maxim": 0xA1,
        "crc16": 0x29B1,
        "crc16_xmodem": 0x31C3,
        "crc16_modbus": 0x4B37,
        "crc32": 0xCBF43926,
        "sum8": sum(b"123456789") % 256,
        "sum16": sum(b"123456789"),
        "xor8": 0x31,
        "none": 0,
    }


@pytest.mark.parametrize("n", [1, 64, 65, 8192])
def test_a_frame_before_its_crc_leaves_no_remainder(n):
    compute = CHECKSUMS["crc16_modbus"].compute
    data = bytes(k * k % 251 for k in range(n))
    assert compute(data + compute(data).to_bytes(2, "little")) == 0


framings = st.builds(
    Framing,
    payload_bytes=st.integers(1, 40),
    start=st.binary(min_size=1, max_size=4),
    end=st.binary(max_size=2),
    sequence_bytes=st.sampled_from([0, 1, 2, 4]),
    skip=st.integers(0, 5),
    checksum=st.sampled_from(list(CHECKSUMS)),
    checksum_from=st.sampled_from(["start", "sequence", "payload"]),
    byte_order=st.sampled_from(["little", "big"]),
)


class TestWithoutErrors:
    @few
    @given(framing=framings, seed=st.integers(0, 2**32))
    def test_a_frame_has_its_stated_length_and_parts(self, framing, seed):
        payload = random.Random(seed).randbytes(framing.payload_bytes)
        raw = framing.encode(payload, 3)
        assert len(raw) == framing.n_bytes
        assert framing.is_whole(raw)
        number = 3 if framing.sequence_bytes else None
        assert framing.frame(raw, 7) == Frame(payload, number, 7)

    @few
    @given(payloads=payloads, cuts=cuts)
    def test_all_frames_with_a_crc_are_found_however_the_stream_is_cut(
        self, payloads, cuts
    ):
        stream = b"".join(WITH_CRC.encode(p, k) for k, p in enumerate(payloads))
        frames, parser = parsed(WITH_CRC, cut(stream, cuts))
        assert [frame.payload for frame in frames] == payloads
        assert [frame.sequence for frame in frames] == list(range(len(payloads)))
        assert [f.end for f in frames] == [
            (k + 1) * WITH_CRC.n_bytes for k in range(len(payloads))
        ]
        assert parser.counts == Counts(frames=len(payloads))

    @few
    @given(payloads=plain_payloads, cuts=cuts)
    def test_without_a_checksum_all_frames_but_the_last_are_found(self, payloads, cuts):
        # The last is not confirmed; two in a row are needed for the first.
        stream = b"".join(PLAIN.encode(p) for p in payloads)
        frames, parser = parsed(PLAIN, cut(stream, cuts))
        found = len(payloads) - 1 if len(payloads) > 2 else 0
        assert [frame.payload for frame in frames] == payloads[:found]
        assert parser.n_waiting == (len(payloads) - found) * PLAIN.n_bytes

    def test_without_confirmation_a_frame_is_accepted_at_its_last_byte(self):
        framing = Framing(12, start=MARK, confirm=False)
        sent = [framing.encode(bytes([k] * 12)) for k in range(6)]
        frames, parser = parsed(framing, sent[:3])
        assert [frame.payload[0] for frame in frames] == [0, 1, 2]
        # A frame that lost a byte takes one of the next along; those after it are right again.
        frames = parser.feed(b"".join([sent[3][:-1], *sent[0:5]]))
        assert [frame.payload[0] for frame in frames] == [3, 1, 2, 3, 4]
        assert frames[0].payload[-1] == MARK[0]

    def test_a_static_pattern_that_looks_like_start_bytes_is_not_believed(self):
        # Two places fit equally: none is taken until the readings change.
        held = b"\x01\x02\x03" + MARK + b"\x04" * 7
        static = PLAIN.encode(held)
        frames, parser = parsed(PLAIN, [static[7:], *[static] * 20])
        assert frames == []
        frames = parser.feed(PLAIN.encode(b"\x05" * 12) * 4)
        assert [frame.payload for frame in frames] == [held] + [b"\x05" * 12] * 3
        # Once in step, the pattern drops no frame.
        frames = parser.feed(static * 5 + PLAIN.encode(bytes(12)))
        assert [frame.payload for frame in frames] == [b"\x05" * 12] + [held] * 5


def damaged(pieces, data, safe):
    """Frames with bytes lost, extra or wrong; `safe`: each is followed by a whole one."""
    out = []
    k = 0
    while k < len(pieces):
        piece = pieces[k]
        n = len(pieces[k])
        kind = data.draw(st.sampled_from(["none", "lost", "extra", "wrong"]))
        at = data.draw(st.integers(0, n - 1))
        run = data.draw(st.integers(1, n - 1))
        noise = st.lists(
            st.integers(0, 0xA9 if safe else 0xFF), min_size=run, max_size=run
        )
        if kind == "lost":
            piece = piece[:at] + piece[at + run :]
        elif kind == "extra":
            piece = piece[:at] + bytes(data.draw(noise)) + piece[at:]
        elif kind == "wrong" and not safe:
            piece = (piece[:at] + bytes(data.draw(noise)) + piece[at + run :])[:n]
        out.append(piece)
        k += 1
        if safe and kind != "none" and k < len(pieces):
            out.append(pieces[k])
            k += 1
    return out


class TestWithErrors:
    @pytest.mark.parametrize("framing", [PLAIN, WITH_CRC], ids=["plain", "crc32"])
    @few
    @given(cuts=cuts, data=st.data())
    def test_damage_makes_no_false_frame(self, framing, cuts, data):
        held = data.draw(payloads if framing.is_strong else plain_payloads)
        sent = [framing.encode(p, k) for k, p in enumerate(held)]
        stream = b"".join(damaged(sent, data, safe=not framing.is_strong))
        frames, parser = parsed(framing, cut(stream, cuts))
        assert is_subsequence(
            [framing.encode(f.payload, f.sequence or 0) for f in frames], sent
        )
        used = parser.counts.frames * framing.n_bytes
        assert len(stream) == used + parser.counts.dropped_bytes + parser.n_waiting

    @pytest.mark.parametrize("framing", [PLAIN, WITH_CRC], ids=["plain", "crc32"])
    @few
    @given(garbage=st.binary(max_size=200), cuts=cuts)
    def test_frames_are_found_again_after_any_garbage(self, framing, garbage, cuts):
        sent = [bytes([k] * 12) for k in range(12)]
        stream = garbage + b"".join(framing.encode(p, k) for k, p in enumerate(sent))
        frames, _ = parsed(framing, cut(stream, cuts))
        # Of the frames that follow, garbage may take the first along, and leave two to decide.
        last = sent[-1:] if framing.is_strong else sent[-2:-1]
        assert [frame.payload for frame in frames][-1:] == last
        assert len(frames) >= 8

    @pytest.mark.parametrize("checksum", ["none", "sum8"])
    def test_a_damaged_frame_costs_itself_alone(self, checksum):
        framing = Framing(12, start=MARK, checksum=checksum)
        sent = [framing.encode(bytes([k] * 12)) for k in range(9)]
        wrong = (
            sent[4][:5] + b"\x05" + sent[4][6:] if checksum == "sum8" else sent[4][:-1]
        )
        frames, parser = parsed(framing, [b"".join([*sent[:4], wrong, *sent[5:]])])
        assert [frame.payload[0] for frame in frames] == [0, 1, 2, 3, 5, 6, 7]
        assert parser.counts.bad_frames == 1
        assert parser.counts.dropped_bytes == len(wrong)

    def test_bytes_that_begin_a_frame_at_every_place_cost_little(self, monkeypatch):
        framing = Framing(1000, start=b"\x00", checksum="crc32")
        checked = []
        whole = Framing.is_whole
        monkeypatch.setattr(
            Framing, "is_whole", lambda me, r: checked.append(1) or whole(me, r)
        )
        parser = FrameParser(framing)
        for _ in range(100):
            parser.feed(bytes(1000))
        assert parser.counts.frames == 0
        assert len(checked) < 100 * 2 * MAX_CHECKS


class TestSequence:
    @few
    @given(
        n_bytes=st.sampled_from([1, 2, 4]),
        first=st.integers(0, 2**32),
        gaps=st.lists(st.integers(0, 100), max_size=20),
    )
    def test_missing_numbers_are_counted_across_the_wrap(self, n_bytes, first, gaps):
        counts = Counts()
        sequence = Sequence(n_bytes, counts)
        number = first
        modulus = 1 << 8 * n_bytes
        assert sequence.admit(number % modulus)
        for gap in gaps:
            number += gap + 1
            assert sequence.admit(number % modulus)
        assert counts == Counts(missing_frames=sum(gaps))

    @pytest.mark.parametrize(
        ("numbers", "admitted", "n_late"),
        [
            ((5, 6, 6, 4, 7), (True, True, False, False, True), 2),
            ((1000, 1001, 0, 1), (True,) * 4, 0),  # a board that starts again
        ],
    )
    def test_a_frame_that_comes_twice_or_late_is_not_used(
        self, numbers, admitted, n_late
    ):
        counts = Counts()
        sequence = Sequence(2, counts)
        assert tuple(sequence.admit(k) for k in numbers) == admitted
        assert counts == Counts(late_frames=n_late)


class TestPackets:
    @few
    @given(payloads=payloads)
    def test_a_packet_of_whole_frames_is_split_and_any_other_counted(self, payloads):
        parser = PacketParser(WITH_CRC)
        packet = b"".join(WITH_CRC.encode(one, k) for k, one in enumerate(payloads))
        assert [frame.payload for frame in parser.feed(packet)] == payloads
        assert parser.feed(packet[:-1]) == []
        dropped = len(packet) - 1
        assert parser.counts == Counts(
            len(payloads), bad_frames=1, dropped_bytes=dropped
        )

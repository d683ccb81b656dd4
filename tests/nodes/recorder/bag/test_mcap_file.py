"""Files of `McapFile` beside those of the package `mcap`: the same bytes for the same calls."""

import io
import random

import pytest
from mcap.writer import CompressionType, Writer

from sparseskin.nodes.recorder.bag.mcap_file import McapFile

N_CALLS = 200


def _of_package(file, chunk_bytes):
    writer = Writer(
        file,
        chunk_size=chunk_bytes,
        compression=CompressionType.LZ4,
        enable_data_crcs=True,
    )
    writer.start(library="test")
    return writer, writer.flush


def _of_this_program(file, chunk_bytes):
    writer = McapFile(file, "test", chunk_bytes)
    return writer, writer.end_chunk


def _written(make, seed):
    """A file of drawn calls."""
    rng = random.Random(seed)
    file = io.BytesIO()
    writer, end_chunk = make(file, chunk_bytes=rng.choice([100, 2000, 10**6]))
    writer.add_metadata("origin", {"scene": "x" * rng.randrange(100)})
    channels = []
    for _ in range(rng.randrange(N_CALLS)):
        kind = rng.random()
        if kind < 0.05 or not channels:
            schema = writer.register_schema("s", "jsonschema", rng.randbytes(50))
            topic = f"/topic{len(channels)}"
            channel = writer.register_channel(topic, "msgpack", schema, {"v": "1"})
            channels.append(channel)
        elif kind < 0.1:
            end_chunk()
        elif kind < 0.12:
            writer.add_metadata("empty", {})
        else:
            channel = rng.choice(channels)
            payload = rng.randbytes(rng.randrange(300))
            log_ns = rng.randrange(2**63)
            stamp_ns = rng.randrange(2**63)
            sequence = rng.randrange(2**32)
            writer.add_message(channel, log_ns, payload, stamp_ns, sequence)
    writer.finish()
    return file.getvalue()


@pytest.mark.parametrize("seed", range(20))
def test_the_same_calls_give_the_bytes_of_the_package(seed):
    assert _written(_of_this_program, seed) == _written(_of_package, seed)

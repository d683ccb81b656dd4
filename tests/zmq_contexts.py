"""Contexts of ZeroMQ for tests, and writers that wait for their readers."""

import pytest
from conftest import wait_until

from sparseskin.nodes.network.sockets import Writer, make_context


@pytest.fixture
def context():
    made = make_context()
    yield made
    made.destroy(linger=0)


def wait_for_reader(writer: Writer, name: str) -> None:
    """Serve the subscriptions of a writer until a reader is present."""

    def is_present() -> bool:
        writer.serve_subscriptions()
        return name in writer.present

    wait_until(is_present, f"the reader {name}")

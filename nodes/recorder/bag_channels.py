"""The channels of a bag that is being written: one a topic and schema, registered at first use."""

from __future__ import annotations

import json
from pathlib import Path

from mcap.writer import Writer

from sparseskin.messages.errors import MessageError
from sparseskin.messages.jsonschema import json_schema
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.lookup import did_you_mean

from .bag import ENCODING, SCHEMA_PREFIX, VERSION_KEY, BagError


class Channels:
    """Numbers of channels, by topic, schema and version; `path` names the bag in errors."""

    def __init__(self, writer: Writer, path: Path) -> None:
        self._writer = writer
        self._path = path
        self._channels: dict[tuple[str, str, int], int] = {}
        self._schemas: dict[tuple[str, int], int] = {}

    def id_of(self, topic: str, schema: str, version: int) -> int:
        """The channel's number.

        Raises
        ------
        BagError
            If the topic is not /PATCH/SCHEMA, or the schema is not known.
        """
        channel = self._channels.get((topic, schema, version))
        if channel is None:
            channel = self._register(topic, schema, version)
            self._channels[topic, schema, version] = channel
        return channel

    def _register(self, topic: str, schema: str, version: int) -> int:
        try:
            split_topic(topic)
        except MessageError as error:
            raise BagError(f"{self._path}: {error}") from error
        if schema not in SCHEMAS:
            hint = did_you_mean(schema, SCHEMAS)
            raise BagError(f"{self._path}: {topic}: schema {schema!r} is not known{hint}")
        if (schema, version) not in self._schemas:
            text = json.dumps(json_schema(SCHEMAS[schema], version))
            self._schemas[schema, version] = self._writer.register_schema(
                SCHEMA_PREFIX + schema, "jsonschema", text.encode()
            )
        return self._writer.register_channel(
            topic, ENCODING, self._schemas[schema, version], {VERSION_KEY: str(version)}
        )

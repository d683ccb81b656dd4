"""docs/json.md documents each field of the JSON that commands print and write, and no other."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import PATIENCE_S, Program, wait_until

from sparseskin.launch.attach.formats import VERSIONS
from sparseskin.launch.commands.cli import main

PAGE = Path(__file__).parents[2] / "docs" / "json.md"
TYPES: dict[str, Callable[[Any], bool]] = {
    "string": lambda value: isinstance(value, str),
    "integer": lambda value: type(value) is int,
    "number": lambda value: type(value) in (int, float),
    "boolean": lambda value: isinstance(value, bool),
    "null": lambda value: value is None,
    "list": lambda value: isinstance(value, list),
    "object": lambda value: isinstance(value, dict),
    "any": lambda value: True,
}
COMMANDS = {
    "source-list": "sources",
    "graph-list": "graph list",
    "node-list": "node list",
    "node-info": "node info reconstructor",
    "param-list": "param list",
    "param-get": "param get compressor ratio",
    "param-set": "param set compressor ratio 4",
    "topic-list": "topic list",
    "topic-info": "topic info /skin/taxels",
    "topic-echo": "topic echo /skin/taxels -n 2",
    "topic-hz": "topic hz /skin/taxels -n 5",
    "topic-bw": "topic bw /skin/taxels -n 5",
    "topic-delay": "topic delay /skin/taxels -n 5",
}
Parts = tuple[str, ...]


def documented() -> dict[str, dict[Parts, set[str]]]:
    """Of each format on the page its fields, as parts of their paths, and the types of each."""
    found: dict[str, dict[Parts, set[str]]] = {}
    for section in PAGE.read_text().split("\n## ")[1:]:
        title = re.match(r"`(.*)`", section)
        assert title is not None
        rows = re.findall(r"^\| `([^`]+)` \| ([^|]+) \|", section, re.MULTILINE)
        paths = [tuple(path.replace("[]", ".[]").split(".")) for path, _ in rows]
        assert len(set(paths)) == len(paths)
        types = [set(text.strip().split(" / ")) for _, text in rows]
        found[title[1]] = dict(zip(paths, types, strict=True))
    return found


def values_of(document: Any, path: Parts = ()) -> Iterator[tuple[Parts, Any]]:
    """Each value of a document, those of lists and objects too, with its path."""
    yield path, document
    if isinstance(document, dict):
        for key, value in document.items():
            yield from values_of(value, (*path, key))
    elif isinstance(document, list):
        for value in document:
            yield from values_of(value, (*path, "[]"))


def matches(path: Parts, pattern: Parts) -> bool:
    return len(path) == len(pattern) and all(
        part == wanted or wanted.isupper() for part, wanted in zip(path, pattern, strict=True)
    )


def check(document: dict[str, Any]) -> None:
    """Check that a document has the documented fields, all that are not optional, and no others."""
    fields = documented()[document["format"]]
    seen = set()
    for path, value in values_of(document):
        if not path:
            continue
        found = [
            pattern
            for pattern, types in fields.items()
            if matches(path, pattern)
            or (types & {"any"} and matches(path[: len(pattern)], pattern))
        ]
        # The literal name first: `topic` is not a KEY.
        found.sort(key=lambda pattern: sum(part.isupper() for part in pattern))
        if not found:
            parents = [p for p in fields if len(p) > len(path) and matches(path, p[: len(path)])]
            assert parents, f"{'.'.join(path)} is not documented"
            assert isinstance(value, dict | list), f"{'.'.join(path)} = {value!r}"
            continue
        seen.add(found[0])
        types = fields[found[0]]
        assert any(TYPES[name](value) for name in types - {"absent"}), (path, value, types)
    for pattern, types in fields.items():
        inside_null = any(
            fields.get(pattern[:k], set()) & {"null", "list"} for k in range(1, len(pattern))
        )
        assert pattern in seen or "absent" in types or inside_null, f"no {'.'.join(pattern)}"


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Program]:
    """A graph with a recorder, that runs until it is stopped."""
    program = Program(
        *("launch", "path_40", "--record", "run.mcap", "--summary", "summary.json"),
        *("--set", "monitor.page=false", "--set", "sensor.rate_hz=50"),
        *("--set", "sensor.source=sparseskin.studies.looped:truth_40"),
        cwd=tmp_path_factory.mktemp("graph"),
    )
    program.wait_for("[launch] ready")
    yield program
    program.kill_all()
    program.process.communicate()


@pytest.fixture
def folder(graph: Program, monkeypatch: pytest.MonkeyPatch) -> Path:
    found = graph.cwd
    monkeypatch.chdir(found)
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(found / "graphs"))
    monkeypatch.setattr("sparseskin.launch.attach.client.PATIENCE_S", PATIENCE_S)
    # These tests run on, in this process.
    monkeypatch.setattr("sparseskin.launch.commands.topic.give_way", lambda: None)
    return found


def test_every_format_is_documented_in_its_version() -> None:
    assert set(documented()) == {f"sparseskin/{name}/{k}" for name, k in VERSIONS.items()}


@pytest.mark.parametrize("name", COMMANDS)
def test_documents_of_a_command_have_the_documented_fields(
    name: str, graph: Program, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wait_until(lambda: main(["graph", "list"]) == 0, "the note of the graph")
    capsys.readouterr()
    assert main([*COMMANDS[name].split(), "--json"]) == 0
    out = capsys.readouterr().out
    a_line_each = name in ("topic-echo", "topic-hz", "topic-bw", "topic-delay")
    for text in out.splitlines() if a_line_each else [out]:
        document = json.loads(text)
        assert document["format"].startswith(f"sparseskin/{name}/")
        check(document)


def test_summaries_and_bag_info_have_the_documented_fields(
    graph: Program, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def has_frames() -> bool:
        capsys.readouterr()
        main(["topic", "info", "/skin/reconstruction", "--json"])
        return bool(json.loads(capsys.readouterr().out)["sent"] > 20)

    wait_until(has_frames, "some frames")
    assert main(["stop"]) == 0
    assert graph.finish()[0] == 130
    summary = json.loads((folder / "summary.json").read_text())
    check(summary)
    capsys.readouterr()
    assert main(["bag", "info", "run.mcap", "--json"]) == 0
    check(json.loads(capsys.readouterr().out))
    words = ["reprocess", "run.mcap", "--out", "again.mcap", "--summary", "again.json"]
    assert main(words) == 0
    again = json.loads((folder / "again.json").read_text())
    check(again)
    (patch,) = again["recordings"]["again.mcap"]["patches"].values()
    assert patch.keys() == summary["patches"]["skin"].keys()
    assert patch["latency_ms"] is None


def test_a_field_that_is_not_documented_or_of_another_type_is_noticed() -> None:
    document = {"format": "sparseskin/param-set/1", "node": "a", "set": {"m": 3}, "answer": "m = 3"}
    check(document)
    for wrong in (
        {**document, "more": 1},
        {**document, "answer": 3},
        {"format": document["format"]},
    ):
        with pytest.raises(AssertionError):
            check(wrong)

"""The table of constants in docs/explanation/skin.md has the values of the dataclass."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path

from sparseskin.nodes.reconstructor.skin.tuning import SkinTuning

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "skin.md"
ROW = re.compile(r"\| [^|]+ \| ([^|]+) \| ([^|]+) \| ([^|]+) \| (`[a-z_]+`(?:; `[a-z_]+`)*) \|")


def rows() -> list[list[str]]:
    """Values, units, origins and fields of each row."""
    text = PAGE.read_text(encoding="utf-8")
    table = text.partition("| field of `SkinTuning` |")[2].partition("\n\n")[0]
    lines = table.splitlines()[2:]
    found = [ROW.fullmatch(line) for line in lines]
    assert None not in found
    return [list(row.groups()) for row in found if row]


def test_each_constant_stands_in_the_table_once_with_its_value() -> None:
    stated: dict[str, object] = {}
    for values, _, _, fields in rows():
        names, numbers = fields.replace("`", "").split("; "), values.split("; ")
        for name, number in zip(names, numbers, strict=True):
            assert name not in stated
            parts = tuple(float(part) for part in number.split(", "))
            stated[name] = parts if len(parts) > 1 else parts[0]
    assert stated == asdict(SkinTuning())


def test_each_constant_has_a_unit_and_an_origin() -> None:
    known = {"derived", "scenes", "recordings", "presses", "chosen"}
    for _, unit, origins, _ in rows():
        assert unit
        assert {origin.split(":")[0] for origin in origins.split("; ")} <= known

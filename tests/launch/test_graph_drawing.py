"""The picture of a graph: every node and link is there, apart from each other."""

from __future__ import annotations

import builtins
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from sparseskin.launch.cli import graph_text, main
from sparseskin.launch.graph_drawing import FONT_PX, bends, svg_of
from sparseskin.launch.graph_layout import CHAR, Box, Curve, layout_of
from sparseskin.launch.launchfile import load

GRAPHS = ("path_40", "two_patches", "many")


def launched(name: str, tmp_path: Path) -> Any:
    if name != "many":
        return load(name, record=str(tmp_path / "out.mcap"))
    path = tmp_path / "many.toml"
    path.write_text("".join(many(tmp_path)))
    return load(str(path), record=str(tmp_path / "out.mcap"))


def many(folder: Path) -> Iterator[str]:
    """Two patches, two monitors and two recorders of each, and all that a recorder more reads."""
    yield "[graph]\n"
    for patch in ("left_palm", "forearm"):
        for node in ("sensor", "compressor", "reconstructor"):
            yield f'[nodes.{node}_of_the_{patch}]\ntype = "{node}"\npatch = "{patch}"\n'
        for k in range(2):
            yield f'[nodes.monitor_{patch}_{k}]\ntype = "monitor"\npatches = ["{patch}"]\n'
            yield f'[nodes.recorder_{patch}_{k}]\ntype = "recorder"\n'
            yield f'out = "{folder}/{patch}{k}.mcap"\ntopics = ["/{patch}/{"t*" if k else "*"}"]\n'


def apart(a: Box, b: Box) -> bool:
    return (
        *(a.x + a.width < b.x, b.x + b.width < a.x),
        *(a.y + a.height < b.y, b.y + b.height < a.y),
    ).count(True) > 0


@pytest.mark.parametrize("name", GRAPHS)
def test_boxes_are_apart_and_nothing_leaves_the_picture(name: str, tmp_path: Path) -> None:
    launch = launched(name, tmp_path)
    layout = layout_of(launch)
    assert [box.lines[0] for box in layout.boxes] == list(launch.nodes)
    for k, box in enumerate(layout.boxes):
        assert all(apart(box, other) for other in layout.boxes[k + 1 :])
        assert box.x >= 0
        assert box.y >= 0
        assert box.x + box.width <= layout.width
        assert box.y + box.height <= layout.height
        assert max(map(len, box.lines)) * CHAR <= box.width
    for curve in layout.curves:
        assert all(0 < x < layout.width and 0 < y < layout.height for x, y in curve.points)
        assert curve.label_start[0] > curve.points[0][0]
        assert curve.label_start[0] + len(curve.label) * CHAR < curve.points[1][0]


def course(curve: Curve) -> Iterator[tuple[float, float]]:
    """Points along a link, close to each other."""
    for a, b, c, d in bends(curve):
        for k in range(201):
            t = k / 200
            x, y = (
                (1 - t) ** 3 * p + 3 * t * (1 - t) ** 2 * q + 3 * t**2 * (1 - t) * r + t**3 * s
                for p, q, r, s in zip(a, b, c, d, strict=True)
            )
            yield x, y


@pytest.mark.parametrize("name", GRAPHS)
def test_no_link_crosses_a_box(name: str, tmp_path: Path) -> None:
    layout = layout_of(launched(name, tmp_path))
    for curve in layout.curves:
        for x, y in course(curve):
            for box in layout.boxes:
                inside_x = box.x + 0.5 < x < box.x + box.width - 0.5
                assert not (inside_x and box.y < y < box.y + box.height), curve.label


@pytest.mark.parametrize("name", GRAPHS)
def test_no_link_runs_through_a_label_and_no_label_over_another(name: str, tmp_path: Path) -> None:
    layout = layout_of(launched(name, tmp_path))
    labels = [
        Box(x, y - FONT_PX + 1, len(curve.label) * CHAR, FONT_PX + 1, (curve.label,), 0)
        for curve in layout.curves
        for x, y in (curve.label_start,)
    ]
    for k, label in enumerate(labels):
        assert all(apart(label, other) for other in [*layout.boxes, *labels[k + 1 :]])
    for curve in layout.curves:
        for x, y in course(curve):
            for label in labels:
                inside_x = label.x < x < label.x + label.width
                assert not (inside_x and label.y < y < label.y + label.height), label.lines


def test_many_nodes_are_12_and_more(tmp_path: Path) -> None:
    assert len(layout_of(launched("many", tmp_path)).boxes) == 15


def test_readers_are_right_of_what_they_read(tmp_path: Path) -> None:
    launch = launched("two_patches", tmp_path)
    left = {box.lines[0]: box.x for box in layout_of(launch).boxes}
    assert all(left[link.writer] < left[link.reader] for link in launch.links)


def test_the_svg_names_all_nodes_topics_and_sources(tmp_path: Path) -> None:
    launch = launched("two_patches", tmp_path)
    root = ElementTree.fromstring(svg_of(launch))
    texts = {element.text for element in root.iter("{http://www.w3.org/2000/svg}text")}
    assert set(launch.nodes) <= texts
    assert "/palm/ phi, measurements" in texts
    assert "/forearm/ skin, taxels, truth" in texts
    assert "scene:lift_box_64" in texts
    n_paths = len(list(root.iter("{http://www.w3.org/2000/svg}path"))) - 1  # one is the arrow head
    assert n_paths == len({(link.writer, link.reader) for link in launch.links})


def test_a_dry_run_writes_both_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    svg, png = tmp_path / "g.svg", tmp_path / "g.png"
    arguments = ["launch", "path_40", "--dry-run", "--svg", str(svg), "--png", str(png)]
    assert main(arguments) == 0
    assert svg.read_text().startswith("<svg ")
    assert png.read_bytes().startswith(b"\x89PNG")
    assert "sensor -- /skin/taxels" in capsys.readouterr().out


def test_the_columns_of_a_dry_run_hold_names_of_any_length(tmp_path: Path) -> None:
    lines = graph_text(launched("many", tmp_path)).splitlines()
    nodes = lines[lines.index("nodes") + 1 : lines.index("links") - 1]
    names = [line.split()[0] for line in nodes]
    types = [line.split()[1] for line in nodes]
    place = 2 + max(map(len, names)) + 1
    assert max(map(len, names)) == len("reconstructor_of_the_left_palm")
    for line, kind in zip(nodes, types, strict=True):
        assert line[place - 1 :].startswith(f" {kind}")
        assert line[place:].ljust(len("reconstructor") + 1)[len("reconstructor")] == " "


def test_what_cannot_be_drawn_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["launch", "path_40", "--svg", "g.svg"]) == 2
    assert capsys.readouterr().err == "--svg, --png: only with --dry-run\n"
    nowhere = str(tmp_path / "no" / "g.svg")
    assert main(["launch", "path_40", "--dry-run", "--svg", nowhere]) == 2
    assert capsys.readouterr().err == f"--svg {nowhere}: No such file or directory\n"
    real = builtins.__import__

    def without_matplotlib(name: str, *rest: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without_matplotlib)
    assert main(["launch", "path_40", "--dry-run", "--png", str(tmp_path / "g.png")]) == 2
    assert "pip install 'sparseskin[charts]'" in capsys.readouterr().err

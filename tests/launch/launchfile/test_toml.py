"""Launch files of hostile size and content: a few lines, soon."""

import pytest

from sparseskin.launch.launchfile.check import MAX_ERROR, MAX_ERRORS, MAX_NODES
from sparseskin.launch.launchfile.load import LaunchError, load
from sparseskin.nodes.toml import MAX_CHARS


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("\n[graph]\ndescription = " + "9" * 5000, ":3: not TOML: a whole number beyond 64 bits"),
        ("[graph]\ndescription = 0x" + "f" * 5000, "graph.description: a whole number beyond 64"),
        ("".join(f"[t{k}]\n" for k in range(200_000)), f"more than {MAX_CHARS} characters"),
        ("\n[graph]\na" + ".a" * 9000 + " = 1", ":3: not TOML: a key of more than 100 parts"),
        ("a" + ".a" * 50 + " = 1", "more than 8 tables or lists in each other"),
        ("a = " + "[" * 900 + "]" * 900, "more than 8 tables or lists"),
        ("".join(f"[nodes.n{k}]\n" for k in range(3000)), f"3000 nodes; at most {MAX_NODES}"),
        ("[graph]\ntransport = 'x" + "y" * 60_000 + "'", "graph.transport: 'xyyy"),
        ("[nodes.n]\ntype = '\\u001b[2J'".replace("'", '"'), r"\x1b[2J"),
    ],
)
def test_a_hostile_file_is_refused_in_lines_that_name_the_place(tmp_path, text, line):
    path = tmp_path / "g.toml"
    path.write_text(text)
    with pytest.raises(LaunchError) as raised:
        load(str(path))
    assert any(line in one for one in raised.value.lines)
    assert max(map(len, raised.value.lines)) < 3 * MAX_ERROR
    assert len(raised.value.lines) <= MAX_ERRORS + 1


def test_of_many_errors_the_first_are_named(tmp_path):
    path = tmp_path / "g.toml"
    path.write_text("".join(f"a{k} = 1\n" for k in range(6000)))
    with pytest.raises(LaunchError) as raised:
        load(str(path))
    assert len(raised.value.lines) == MAX_ERRORS + 1

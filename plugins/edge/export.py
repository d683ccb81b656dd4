"""Export of an edge as a folder of C99 files."""

from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

import numpy as np

from sparseskin.messages.quantised import largest_code
from sparseskin.nodes.compressor.phi.hadamard import block_sizes
from sparseskin.nodes.compressor.quantiser import SMALLEST
from sparseskin.nodes.files import whole_folder

from .description import Counts, EdgeDescription, compressed

DESCRIPTION = "edge.toml"
COPIED = (
    "edge.h",
    "edge.c",
    "edge_tables.h",
    "edge_check.h",
    "edge_check.c",
    "edge_test.c",
    "edge_stream.c",
    "Makefile",
    "cortex_m4/main.c",
    "cortex_m4/link.ld",
    "avr/main.c",
    "arduino/arduino.ino",
)
"""Files that are the same for every edge."""
OF_SKETCH = ("edge.h", "edge.c", "edge_tables.h", "edge_config.h", "edge_tables.c")
"""Files that stand beside the sketch once more, where the Arduino IDE looks for them."""


def export(description: EdgeDescription, out: Path) -> None:
    """Write the program of an edge into a new folder. Raises OutputError if the folder exists or
    cannot be written; SettingsError if two row subsets have the same short fingerprint.
    """
    # All texts are made before the folder: what raises leaves no half of a program.
    texts = {
        DESCRIPTION: description.to_toml(),
        "README.md": readme(description),
        "edge_config.h": config(description),
        "edge_tables.c": tables(description),
        "edge_vectors.h": vectors(description),
    }
    source = files(__package__) / "c"
    with whole_folder(out):
        for name in COPIED:
            texts[name] = (source / name).read_text(encoding="utf-8")
        for name in OF_SKETCH:
            texts[f"arduino/{name}"] = texts[name]

        for name, text in texts.items():
            (out / name).parent.mkdir(exist_ok=True)
            (out / name).write_text(text, encoding="utf-8")


def config(description: EdgeDescription) -> str:
    """Text of `edge_config.h`: sizes and types."""
    d = description
    # The program has no floating point: the step is written by its bits.
    step_of_zeros = int(np.float32(SMALLEST / largest_code(d.bits)).view(np.uint32))
    attributes = (
        "n_rows",
        "n_cols",
        "n_cells",
        "n_taxels",
        "m",
        "bits",
        "count_bytes",
        "frame_bytes",
    )
    numbers = {name.upper(): getattr(d, name) for name in attributes}
    numbers |= {
        "BLOCK": max(block_sizes(d.n_taxels, d.block)),
        "N_GROUPS": len(_groups(d)),
        "N_SUBSETS": len(d.subsets),
        "FULL_SCALE": f"{d.full_scale}u",
        "STEP_OF_ZEROS": f"0x{step_of_zeros:08x}u /* the step of a frame of zeros, float32 */",
        "FIRST_CELL": int(d.cells[0]),
    }
    defines = "\n".join(
        f"#define EDGE_{name} {value}" for name, value in numbers.items()
    )
    return _filled("edge_config.h.in", defines=defines, count_bits=8 * d.count_bytes)


def tables(description: EdgeDescription) -> str:
    """Text of `edge_tables.c`: the permutation, the rows and the scales."""
    d = description
    groups = []
    for size, count in _groups(d):
        # In float32, as SbhePhi rounds it.
        scale = np.reciprocal(np.sqrt(np.float32(size)))
        mantissa, exponent = np.frexp(scale)
        log2_size = size.bit_length() - 1
        fraction = int(np.ldexp(float(mantissa), 32))
        shift = int(exponent) - 1
        groups.append(f"{{{count}, {log2_size}, {shift}, 0x{fraction:08x}u}}")

    # A bit for each row of the Hadamard transform, set if it is measured.
    rows = []
    for phi in d.subsets:
        is_chosen = np.zeros(-(-d.n_taxels // 32) * 32, dtype=bool)
        is_chosen[phi.rows] = True
        words = np.packbits(is_chosen, bitorder="little").view("<u4")
        rows.append(_array(f"0x{word:08x}u" for word in words.tolist()))
    cells = d.cells[d.phi.permutation]
    return _filled(
        "edge_tables.c.in",
        groups=_array(groups),
        cells=_array(map(str, cells.tolist())),
        rows=",\n".join(rows),
        tags=_array(f"0x{tag:08x}u" for tag in d.tags),
    )


def vectors(description: EdgeDescription) -> str:
    """Text of `edge_vectors.h`: the hash of each test frame's bytes."""
    # Every row subset is used, and the first three frames are special ones.
    n_vectors = len(description.subsets) + 6
    # The program makes the same frames on the board, and compares hashes alone.
    frames = (check_counts(description, k) for k in range(n_vectors))
    hashes = [fnv1a(frame) for frame in compressed(description, frames)]
    values = _array(f"0x{value:08x}u" for value in hashes)
    return _filled("edge_vectors.h.in", n_vectors=n_vectors, hashes=values)


def readme(description: EdgeDescription) -> str:
    """Text of `README.md`."""
    d = description
    of_mask = ""
    if d.mask is not None:
        of_mask = f", {d.n_taxels} of which hold a taxel"
    tags = ", ".join(f"`{tag:08x}`" for tag in d.tags)
    attributes = (
        "n_rows",
        "n_cols",
        "m",
        "rows",
        "bits",
        "full_scale",
        "code_bytes",
        "frame_bytes",
    )
    values = {name: getattr(d, name) for name in attributes}
    values |= {
        "masked": of_mask,
        "n_subsets": len(d.subsets),
        "top": largest_code(d.bits),
    }
    return _filled("README.md.in", tags=tags, **values)


def _filled(name: str, **values: object) -> str:
    """A text of the folder `c` with its values, which stand there as @NAME@."""
    text = (files(__package__) / "c" / name).read_text(encoding="utf-8")
    for key, value in values.items():
        text = text.replace(f"@{key}@", str(value))
    return text


def _groups(description: EdgeDescription) -> list[tuple[int, int]]:
    """Sizes of the Hadamard blocks in their order, and how many there are of each."""
    # Equal sizes follow each other: a size and its number are a group.
    sizes = block_sizes(description.n_taxels, description.block)
    return [(size, sizes.count(size)) for size in dict.fromkeys(sizes)]


def _array(items: Iterable[str]) -> str:
    """Items as the braces of a C array, lines of at most about 100 characters."""
    lines = []
    line = "    "
    for item in items:
        if len(line) + len(item) > 98:
            lines.append(line.rstrip())
            line = "    "
        line += f"{item}, "
    lines.append(line.rstrip().rstrip(","))
    return "{\n" + "\n".join(lines) + "}"


def check_counts(description: EdgeDescription, k: int) -> Counts:
    """Return the counts of test frame k, uint16 (n_rows, n_cols), as `edge_check.c` makes them."""
    d = description
    counts = np.zeros(d.n_cells, dtype=np.uint16)
    if k == 1:
        counts[:] = d.full_scale
    elif k == 2:
        counts[d.cells[0]] = 1
    # Xorshift numbers, in all cells or in one of sixteen.
    elif k > 2:
        state = 2463534242 + k
        for i in range(d.n_cells):
            state ^= (state << 13) & 0xFFFFFFFF
            state ^= state >> 17
            state ^= (state << 5) & 0xFFFFFFFF
            if k & 1 or state >> 28 == 0:
                counts[i] = state & d.full_scale
    return counts.reshape(d.n_rows, d.n_cols)


def fnv1a(data: bytes) -> int:
    """Return the 32-bit FNV-1a hash of bytes."""
    value = 0x811C9DC5
    for byte in data:
        value = (value ^ byte) * 0x01000193 & 0xFFFFFFFF
    return value

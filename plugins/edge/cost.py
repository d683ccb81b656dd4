"""Instructions and memory of an exported edge on a Cortex-M4, by a cross compiler and QEMU."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from .description import EdgeDescription, EdgeError
from .export import export

TOOLS = {
    "make": "make",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
}
"""Programs that are needed, and Debian's packages of them."""
LONGEST_S = 300.0
"""Time after which the emulator is ended, seconds; it takes less than one."""


@dataclass(frozen=True)
class EdgeCost:
    """The cost of an edge on a Cortex-M4.

    Attributes
    ----------
    instructions, most_instructions : int
        Instructions to compress a frame, its CRC included: mean and largest of 32 test frames.
    code_bytes, table_bytes : int
        Read-only memory (flash) of the program and of its tables.
    ram_bytes : int
        Memory that lasts from frame to frame: `edge_t`, the counts and the frame to send.
    stack_bytes : int
        Upper bound of the stack: the sum over all functions of `edge.c`.
    """

    instructions: int
    most_instructions: int
    code_bytes: int
    table_bytes: int
    ram_bytes: int
    stack_bytes: int


def missing_tools() -> list[str]:
    """Return the programs of `TOOLS` that are not installed, with their packages."""
    absent = {tool: package for tool, package in TOOLS.items() if shutil.which(tool) is None}
    return [f"{tool} (Debian: {package})" for tool, package in absent.items()]


def measure_cost(description: EdgeDescription) -> EdgeCost:
    """Export an edge, compile it for a Cortex-M4, and run its self-test and 32 frames in QEMU.
    Raises EdgeError if a tool is missing or fails, or a frame has other bytes than expected.

    Notes
    -----
    Instructions are counted by QEMU (`-icount`), whose time per instruction is fixed; a Cortex-M4
    needs 1 to 2 cycles for most of them, which QEMU does not model.
    """
    missing = missing_tools()
    if missing:
        raise EdgeError(f"{', '.join(missing)}: not installed")
    with TemporaryDirectory() as folder:
        out = Path(folder) / "edge"
        export(description, out)
        command = ["make", "--silent", "cortex-m4"]
        try:
            done = subprocess.run(
                command, cwd=out, capture_output=True, text=True, timeout=LONGEST_S, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise EdgeError(f"make cortex-m4: not done after {LONGEST_S:g} s") from error
        text = done.stdout + done.stderr
        if done.returncode:
            raise EdgeError(f"make cortex-m4 failed: {' / '.join(text.splitlines()[-3:])}")
        stack = (out / "edge_m4.su").read_text(encoding="utf-8")
    sizes = {name: int(size) for size, name in re.findall(r"^ *(\d+).*?(\w+)\.o$", text, re.M)}
    numbers = {name: int(number) for name, number in re.findall(r"^(\w+ \w+) (\d+)$", text, re.M)}
    d = description
    return EdgeCost(
        instructions=numbers["instructions mean"],
        most_instructions=numbers["instructions most"],
        code_bytes=sizes["edge_m4"],
        table_bytes=sizes["edge_tables_m4"],
        ram_bytes=4 * d.m + 4 + d.n_cells * d.count_bytes + d.frame_bytes,
        stack_bytes=sum(int(line.split("\t")[1]) for line in stack.splitlines()),
    )

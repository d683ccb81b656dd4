"""The edge on an emulated Cortex-M4: the same bytes, and the cost of a frame."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.plugins.edge import cost
from sparseskin.plugins.edge.cost import measure_cost, missing_tools
from sparseskin.plugins.edge.description import EdgeDescription, EdgeError

needs_tools = pytest.mark.skipif(
    bool(missing_tools()), reason=f"not installed: {', '.join(missing_tools())}"
)
NAMES = ("instructions", "most", "code", "table", "ram", "stack")


@needs_tools
def test_a_cortex_m4_sends_the_expected_bytes_and_its_memory_is_counted() -> None:
    d = EdgeDescription.chosen(16, 32, ratio=3)
    found = measure_cost(d)  # raises where a frame has other bytes
    # Each taxel is read at least once, in a load and a sum.
    assert 2 * d.n_taxels < found.instructions <= found.most_instructions
    assert found.table_bytes >= 2 * d.n_taxels + 3 * d.n_taxels // 8
    assert found.ram_bytes == 4 * (d.m + 1) + 2 * d.n_taxels + d.frame_bytes
    assert found.code_bytes > 0
    assert found.stack_bytes >= 4 * d.block
    assert measure_cost(d) == found  # the count is no measured time


@needs_tools
def test_an_emulated_loop_of_known_length_is_counted_to_the_instruction(tmp_path: Path) -> None:
    out = tmp_path / "edge"
    cost.export(EdgeDescription.chosen(2, 2, ratio=2), out)
    path = out / "cortex_m4" / "main.c"
    compress = "    edge_compress(&edge, counts, frame);\n"
    loop = "mov r3, #10000\\n1: subs r3, r3, #1\\n bne 1b"
    text = path.read_text()
    assert text.count(compress) == 1
    path.write_text(text.replace(compress, f'    __asm__ volatile("{loop}" ::: "r3", "cc");\n'))
    command = ["make", "--silent", "cortex-m4"]
    done = subprocess.run(command, cwd=out, capture_output=True, text=True, check=False)
    # 20001 and the return; the time of an instruction is one and a half ticks.
    assert "instructions mean 2000" in done.stdout + done.stderr


def test_a_missing_tool_is_named_with_its_package(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None if "arm" in name else f"/{name}")
    line = (
        "arm-none-eabi-gcc (Debian: gcc-arm-none-eabi), qemu-system-arm (Debian: qemu-system-arm): "
        "not installed"
    )
    with pytest.raises(EdgeError) as refused:
        measure_cost(EdgeDescription.chosen(2, 2, ratio=2))
    assert str(refused.value) == line
    assert main(["edge", "cost"]) == 2
    assert capsys.readouterr().err == f"{line}\n"

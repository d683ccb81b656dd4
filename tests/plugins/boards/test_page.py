"""The page on boards: its profile and its firmware."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from sparseskin.plugins.boards.framing import Frame
from sparseskin.plugins.boards.source import describe_board

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs/howto/boards.md"


def fenced(language):
    """The first fenced block of a language."""
    found = re.search(rf"^```{language}\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert found
    return found[1]


def test_the_profile_and_the_firmware_of_the_page_on_boards_send_what_they_state(tmp_path):
    path = tmp_path / "my_board.toml"
    path.write_text(fenced("ini"), encoding="utf-8")
    board = describe_board(f"serial:/dev/ttyUSB0?profile={path}")
    assert (board.skin.shape, board.skin.f_max) == ((12, 8), 4095.0)
    numbered = describe_board("serial:/dev/ttyUSB0?profile=numbered&rows=8&cols=8")
    if (compiler := shutil.which("cc")) is None:
        pytest.skip("no C compiler")
    code = (ROOT / "examples" / "numbered_firmware.c").read_text()
    main = (
        "#include <stdio.h>\nint main(void) { uint16_t r[N]; uint8_t out[6 + 2 * N];"
        " for (int k = 0; k < N; k++) r[k] = (uint16_t)(k * 1000);"
        " return fwrite(out, 1, frame(out, 513, r), stdout) == 0; }\n"
    )
    (tmp_path / "board.c").write_text(code + main, encoding="utf-8")
    subprocess.run([compiler, "-o", "board", "board.c"], cwd=tmp_path, check=True)
    sent = subprocess.run([tmp_path / "board"], capture_output=True, check=True).stdout
    readings = (np.arange(64) * 1000).astype("<u2").tobytes()
    assert numbered.framing.frame(sent, 0) == Frame(readings, 513, 0)
    assert numbered.framing.is_whole(sent)

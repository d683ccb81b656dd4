"""Graphs of real processes: complete from the first frame, and gone at the end."""

import json
import os
import shutil
import signal

import numpy as np
import pytest
from bags import launched
from conftest import wait_until
from processes import SENSOR

from sparseskin.launch.launchfile.load import BUNDLED
from sparseskin.messages import Reconstruction, decode
from sparseskin.nodes.recorder.bag.reader import BagReader

EVERY_FRAME = ("--set", "reconstructor.depth=0")
SLOWLY = (
    "--set",
    "sensor.rate_hz=20",
    "--set",
    "reconstructor.iterations=3",
    *EVERY_FRAME,
)
NONE_MISSING = {"skipped": 0, "quiet": 0, "lost": 0, "unpaired": 0}
TAP = """
import numpy as np
from sparseskin.nodes.node import Node
from sparseskin.nodes.settings import PatchSettings
KINDS = ("reconstruction",)

class Tap(Node):
    Settings = PatchSettings

    def __init__(self, settings, context):
        super().__init__(settings, context)
        self.frames, self.seen = [], set()

    @classmethod
    def inputs(cls, settings):
        return [f"/{settings.patch}/{kind}" for kind in KINDS]

    def step(self, message):
        self.seen.add(message.schema)
        assert KINDS[0] in self.seen
        if message.schema == KINDS[-1]:
            self.frames.append(message.forces[0])
        return ()

    def ended(self, topic, n_messages):
        np.save("tap.npy", np.array(self.frames))
        return ()
"""

FAST = """
import pathlib
import time
import numpy as np
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver

N = 4000
SENT, GO = map(pathlib.Path, ("sent", "go"))

def frames():
    forces = np.full((16, 16), 0.5)
    for k in range(N):
        yield k, forces
    SENT.touch()

class Held(FistaSolver):
    def finish(self):
        while not GO.exists():
            time.sleep(0.01)
        return super().finish()
"""


@pytest.mark.slow
def test_not_one_frame_is_lost_from_the_first_on(start, tmp_path):
    # As fast as the sensor can: whatever is not joined at the start would be lost. More than a
    # queue holds: only a sensor that waits for its readers loses nothing.
    program = start(
        *("launch", "lift_box_40", "--frames", "1200", "--summary", "out.json"),
        *("--set", "sensor.source=scene:path_40", "--set", "sensor.rate_hz=0"),
        *("--set", "reconstructor.iterations=1"),
        environment={"SPARSESKIN_FAST": "auto"},
    )
    stdout, _ = program.ended()
    summary = json.loads((tmp_path / "out.json").read_text())
    patch = summary["patches"]["skin"]
    assert patch["frames"] == {"sensed": 1200, "reconstructed": 1200, **NONE_MISSING}
    found = {
        key: patch[key] for key in ("scene", "phi", "rows", "basis", "solver", "n", "m")
    }
    assert found == {
        **{
            "scene": "path_40",
            "phi": "sbhe",
            "rows": "rotating",
            "basis": "",
            "solver": "skin",
        },
        **{"n": 1600, "m": 534},
    }
    assert patch["ratio"] == pytest.approx(1600 / 534)
    assert patch["bytes_in"] > 1200 * 1600 * 4
    assert 1200 * 534 * 4 < patch["bytes_out"] < patch["bytes_in"]
    for key in ("noisy", "reconstruction"):
        extent = patch["psnr_db"][key]["all"]
        assert extent["min"] <= extent["mean"] <= extent["max"]
    for key in ("latency_ms", "solve_ms"):
        assert 0 < patch[key]["p50"] <= patch[key]["p99"]
    assert patch["solve_ms"]["p50"] <= patch["latency_ms"]["p50"]
    for node in summary["nodes"].values():
        assert not any(node["lost"].values())
        assert not node["refused"]
    assert "sensed 1200, reconstructed 1200, lost 0" in stdout
    assert program.survivors() == {}


@pytest.mark.slow
def test_live_replayed_and_by_any_executor_the_forces_are_the_same_bits(
    start, tmp_path
):
    same = ("--set", "reconstructor.iterations=8")
    quiet = ("--set", "monitor.page=false")
    frames = ("--frames", "40")
    live = ("lift_wrench_40", *frames, *EVERY_FRAME, "--record", "live.mcap")
    start("launch", *live, *same, *quiet).ended()
    replay = ("--set", "player.file=live.mcap", "--set", "player.rate=0")
    again = ("replay_measurements", *replay, *EVERY_FRAME, "--record", "again.mcap")
    start("launch", *again, *same, *quiet).ended()
    shutil.copy(tmp_path / "live.mcap", tmp_path / "twin.mcap")
    for executor in ("serial", "thread:2", "process:2"):
        batch = ("live.mcap", "twin.mcap", "--out", executor, "--executor", executor)
        (tmp_path / executor).mkdir()
        start("reprocess", *batch, *same).ended()

    expected = forces_in(tmp_path / "live.mcap")
    assert len(expected) == 40
    assert np.any(expected)
    others = sorted({*tmp_path.rglob("*.mcap")} - {tmp_path / "live.mcap"})
    assert len(others) == 2 + 3 * 2
    for path in others:
        assert forces_in(path).tobytes() == expected.tobytes()


def forces_in(path):
    """Forces of all frames that a recording has, in their order."""
    with BagReader(path) as bag:
        messages = [
            decode(recorded.topic.encode(), recorded.payload)
            for recorded in bag.messages(["/skin/reconstruction"])
        ]
    return np.array([m.forces[0] for m in messages if isinstance(m, Reconstruction)])


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
@pytest.mark.slow
def test_over_any_transport_the_forces_are_the_same_bits(start, tmp_path, transport):
    # The solver is made before the first frame is acquired.
    (tmp_path / "tap.py").write_text(
        TAP.replace('"recon', '"solver", "taxels", "recon')
    )
    bundled = BUNDLED / "lift_wrench_40.toml"
    text = bundled.read_text().replace("[graph]", f'[graph]\ntransport = "{transport}"')
    (tmp_path / "tapped.toml").write_text(text + '\n[nodes.tap]\ntype = "tap:Tap"\n')
    # Live, the host's speed would choose their number.
    iterations = ["reconstructor.iterations=8"]
    _, stderr = start(
        *(
            "launch",
            "tapped.toml",
            "--frames",
            "150",
            "--set",
            *iterations,
            *EVERY_FRAME,
        ),
        environment={"SPARSESKIN_FAST": "auto"},
    ).ended()
    assert ("warning: tcp and no keys" in stderr) == (transport == "tcp")
    between_processes = np.load(tmp_path / "tap.npy")

    bus = launched("lift_wrench_40", *iterations)
    in_process = [
        message.forces[0]
        for messages in bus.frames(150)
        for message in messages
        if isinstance(message, Reconstruction)
    ]
    assert between_processes.shape == (150, 40, 40)
    assert between_processes.tobytes() == np.array(in_process).tobytes()


def test_an_interrupt_drains_the_graph_reports_and_leaves_nothing(start, tmp_path):
    program = start("launch", "path_40", "--summary", "out.json", *SLOWLY)
    program.wait_for("[launch] ready")
    program.process.send_signal(signal.SIGINT)
    stdout, _ = program.ended(130)
    assert "path_40: skin" in stdout
    frames = json.loads((tmp_path / "out.json").read_text())["patches"]["skin"][
        "frames"
    ]
    assert (frames["sensed"], program.survivors()) == (frames["reconstructed"], {})


def test_a_launcher_that_is_killed_as_it_starts_leaves_nothing(start, sensor):
    program = start("launch", sensor)
    wait_until(lambda: len(program.survivors()) > 1, "the first node")
    program.process.kill()
    wait_until(lambda: not program.survivors(), "the nodes to notice")


def test_a_node_that_is_killed_is_named_and_the_others_are_ended(start, tmp_path):
    (tmp_path / "two.toml").write_text(
        f'{SENSOR}[nodes.compressor]\ntype = "compressor"\n'
    )
    program = start("launch", "two.toml")
    program.wait_for("[launch] ready")
    os.kill(program.pid_of("sensor"), signal.SIGTERM)
    _, stderr = program.ended(1)
    assert "[sensor] error: terminated (SIGTERM)" in stderr
    assert program.survivors() == {}


def test_a_driver_that_blocks_does_not_outlive_a_killed_launcher(
    start, sensor, tmp_path
):
    (tmp_path / "stuck.py").write_text(
        "import numpy as np, sys, time\n"
        "def frames():\n"
        "    yield 0, np.zeros((4, 4))\n"
        "    print('stuck', file=sys.stderr, flush=True)\n"
        "    while True: time.sleep(3600)\n"
    )
    program = start("launch", sensor, "--set", "sensor.source=stuck:frames")
    program.wait_for("stuck")
    program.process.kill()
    wait_until(lambda: not program.survivors(), "the nodes to notice")


@pytest.mark.slow
def test_a_graph_that_is_too_slow_loses_frames_counts_them_and_ends(start, tmp_path):
    # The first frame is solved when all have been sent: twice what the queues hold.
    (tmp_path / "fast.py").write_text(FAST)
    program = start(
        *(
            "launch",
            "replay",
            "--set",
            "sensor.source=fast:frames",
            "--summary",
            "out.json",
        ),
        *("--set", "sensor.rate_hz=4000"),  # one without a rate waits for its readers
        *(
            "--set",
            "reconstructor.solver=fast:Held",
            "--set",
            "reconstructor.iterations=1",
        ),
    )
    wait_until((tmp_path / "sent").exists, "the last frame")
    (tmp_path / "go").touch()
    program.ended()
    summary = json.loads((tmp_path / "out.json").read_text())
    frames = summary["patches"]["skin"]["frames"]
    assert frames["sensed"] == 4000
    assert frames["lost"] > 0
    missed = [sum(node["lost"].values()) for node in summary["nodes"].values()]
    # at the compressor and the reconstructor
    assert frames["lost"] == missed[1] + missed[2]


def test_readings_outside_the_range_are_clipped_but_not_silently(start, tmp_path):
    (tmp_path / "upside.py").write_text(
        "import numpy as np\n"
        "def frames():\n"
        "    try:\n"
        "        for k in range(10): yield k, np.full((5, 4), 3.5 if k == 7 else -1.0 - k)\n"
        "    finally:\n"
        "        open('closed', 'w').close()\n"
    )
    (
        tmp_path / "state"
    ).touch()  # in the place of the default folder of logs: a warning
    stdout, stderr = start(
        *(
            "launch",
            "replay",
            "--set",
            "sensor.source=upside:frames",
            "--summary",
            "out.json",
        ),
        *("--frames", "12"),
    ).ended()
    folder = tmp_path / "state" / "sparseskin" / "log"
    line = f"warning: no log files: {folder}: Not a directory; graph.log_dir states another"
    assert line in stderr.splitlines()
    assert "the source ended after 10 of the 12 frames" in stderr
    assert (tmp_path / "closed").exists()
    assert "readings clipped to the range: 20 below 0 N (lowest -1)" in stderr
    assert " replay: skin, upside:frames " in stdout
    summary = json.loads((tmp_path / "out.json").read_text())
    assert summary["nodes"]["sensor"]["clipped"] == 200
    line = "20 above 2.5 N (highest 3.5), 180 below 0 N (lowest -10)"
    assert stdout.splitlines()[-1] == f"sensor: readings clipped to the range: {line}"


def test_a_run_in_which_a_node_raised_errors_is_no_success(start, tmp_path):
    fails = (
        "    def step(self, message):\n        raise ValueError('\\x1b[2Jno\\x07')\n"
    )
    (tmp_path / "mine.py").write_text(TAP.partition("    def step")[0] + fails)
    number = len((tmp_path / "mine.py").read_text().splitlines())
    text = BUNDLED / "path_40.toml"
    (tmp_path / "own.toml").write_text(
        text.read_text() + '\n[nodes.own]\ntype = "mine:Tap"\n'
    )
    stdout, stderr = start(
        *("launch", "own.toml", "--frames", "20", "--summary", "out.json"),
        *("--set", "graph.log_dir=logs", "--set", "monitor.page=false", *EVERY_FRAME),
    ).ended(1)
    assert "reconstructed 20, lost 0" in stdout
    assert f"[own] failed: ValueError: \\x1b[2Jno\\x07 (mine.py:{number})\n" in stderr
    assert "[launch] own raised 20 errors" in stderr
    summary = json.loads((tmp_path / "out.json").read_text())
    assert summary["nodes"]["own"]["refused"] == {"failed": 20}
    assert summary["nodes"]["own"]["errors"] == 20
    (log,) = (tmp_path / "logs").glob("*/own.log")
    assert "Traceback (most recent call last):" in log.read_text()
    assert f'mine.py", line {number}, in step' in log.read_text()
    assert all(line.isprintable() for line in log.read_text().split("\n"))


def test_modules_beside_a_launch_file_are_found_and_hide_no_installed_ones(
    start, tmp_path
):
    folder = tmp_path / "project"
    folder.mkdir()
    (folder / "tap_beside.py").write_text(TAP.replace("reconstruction", "taxels"))
    (folder / "msgpack.py").write_text("raise SystemExit('was imported')\n")
    (folder / "driver_beside.py").write_text(
        "import msgpack\ndef frames():\n    for k in range(5):\n        yield k, [[0.5, 1.0]]\n"
    )
    (folder / "graph.toml").write_text(
        '[nodes.sensor]\ntype = "sensor"\nsource = "driver_beside:frames"\n'
        '[nodes.tap]\ntype = "tap_beside:Tap"\n'
    )
    _, stderr = start("launch", "project/graph.toml").ended()
    assert np.load(tmp_path / "tap.npy").tolist() == [[[0.5, 1.0]]] * 5
    _, stderr = start(
        "launch", "project/graph.toml", "--set", "sensor.source=no_driver:frames"
    ).ended(2)
    (line,) = stderr.splitlines()
    assert f"no module 'no_driver', installed or in {folder} or {tmp_path}" in line

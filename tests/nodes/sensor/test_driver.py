"""A user's own driver: found by name, checked frame by frame, its faults named."""

import re
import sys
import textwrap

import numpy as np
import pytest
from damaged import refusal

from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError, SourceError
from sparseskin.nodes.node import Context
from sparseskin.nodes.sensor import driver
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.node import Sensor, SensorSettings
from sparseskin.nodes.sensor.sources import DriverAddress, open_source


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Write a module into the current directory and return its name."""
    monkeypatch.chdir(tmp_path)

    def write(body):
        name = f"a_driver_{len(list(tmp_path.iterdir()))}"
        text = "import numpy as np\n" + textwrap.dedent(body)
        (tmp_path / f"{name}.py").write_text(text)
        return name

    return write


def opened(target, raw=False, **stated):
    return driver.open_callable(DriverAddress(target, Layout(**stated), raw=raw))


def yielding(module, *pairs):
    """Open a generator of the given pairs, written as Python expressions."""
    lines = "\n".join(f"    yield {pair}" for pair in pairs)
    return opened(module(f"def frames():\n{lines}\n") + ":frames")


class TestFrames:
    def test_frames_and_skin_of_a_generator_are_those_from_the_first_on(self, module):
        source = yielding(
            module, "(1000, np.full((2, 3), 0.5))", "(1010, [[1, 2, 0], [0, 1, 2]])"
        )
        assert source.skin.shape == (2, 3)
        assert source.skin.f_max == 2.5
        assert source.skin.unit == "N"
        assert source.delivers == "taxels"
        assert source.rate_hz is None
        assert source.n_frames is None
        assert source.name.endswith(":frames")
        frames = list(source)
        assert [stamp for stamp, _ in frames] == [0, 10]
        assert all(forces.dtype == np.float32 for _, forces in frames)
        np.testing.assert_array_equal(frames[0][1], np.full((2, 3), 0.5))
        np.testing.assert_array_equal(frames[1][1], [[1, 2, 0], [0, 1, 2]])

    def test_a_first_frame_of_another_shape_than_stated_is_refused(self, module):
        name = module("def frames():\n    yield 0, np.zeros((2, 3))\n")
        assert open_source(
            f"{name}:frames", layout=Layout(n_rows=2, n_cols=3)
        ).skin.shape == (2, 3)
        with pytest.raises(
            SourceError, match="n_cols = 4 is stated, but the frames have 3"
        ):
            open_source(f"{name}:frames", layout=Layout(n_rows=2, n_cols=4))

    def test_readings_beyond_the_range_saturate_and_are_counted(self, module):
        source = yielding(
            module, "(0, [[-0.1, 2.6, 2.5, 0.0]])", "(1, [[1e300, 1, 1, -1e300]])"
        )
        expected = [[[0, 2.5, 2.5, 0]], [[2.5, 1, 1, 0]]]
        np.testing.assert_array_equal([forces for _, forces in source], expected)
        assert source.clipped.n == 4

    @pytest.mark.parametrize(
        ("second", "message"),
        [
            (
                "(1, np.zeros((3, 2)))",
                r"frame 1: forces have shape \(3, 2\), .* skin has \(2, 3\)",
            ),
            (
                "(1, [[0, np.nan, 0], [0, 0, 0]])",
                "frame 1, row 0, column 1: nan is no force",
            ),
            (
                "(1, np.zeros((2, 3), complex))",
                "dtype 'complex128'; allowed are integers",
            ),
            ("(1, [[1, 2], [3]])", "forces are no array of numbers"),
            ("(0, np.zeros((2, 3)))", "stamp_ns 0 is not after the one before it, 0"),
            ("(2**63, np.zeros((2, 3)))", r"more than 2\*\*63 ns after the first"),
            ("np.zeros((2, 3))", "frame 1: delivered ndarray; expected a pair"),
            ("1 / 0", "the driver failed: ZeroDivisionError: division by zero"),
        ],
    )
    def test_a_bad_frame_is_named_and_not_passed_on(self, module, second, message):
        source = yielding(module, "(0, np.zeros((2, 3)))", second)
        reader = iter(source)
        next(reader)
        shown = refusal(lambda: next(reader), SourceError)
        assert re.search(f"{source.name}.*{message}", shown)

    def test_a_stamp_that_goes_back_by_a_second_is_of_a_clock_that_was_started_again(
        self, module
    ):
        source = yielding(module, *(f"({k} * 10**9, [[1.0]])" for k in (5, 4, 7)))
        assert [stamp for stamp, _ in source] == [0, 1, 3 * 10**9 + 1]


class TestLife:
    BODY = """
        events = []
        def frames():
            try:
                for k in range(3):
                    yield k, [[1.0]]
            finally:
                events.append("closed")
    """

    def test_the_driver_is_closed_once_when_reading_stops_early(self, module):
        name = module(self.BODY)
        source = opened(f"{name}:frames")
        next(iter(source))
        source.close()
        source.close()
        assert sys.modules[name].events == ["closed"]

    def test_a_generator_is_not_read_twice(self, module):
        source = opened(module(self.BODY) + ":frames")
        assert len(list(source)) == 3
        with pytest.raises(SourceError, match="was read before"):
            list(source)


class TestSourceObject:
    BODY = """
        from sparseskin.nodes.sensor.source import Skin

        class Hand:
            name = "hand"
            delivers = "truth"
            rate_hz = 200.0
            n_frames = 1
            skin = Skin(1, 3, 4.0, mask=np.array([[True, True, False]]))

            def __iter__(self):
                yield 7, np.array([[1.0, 5.0, np.nan]])
    """

    def test_its_own_attributes_hold_and_masked_cells_do_not_count(self, module):
        source = opened(module(self.BODY) + ":Hand")
        assert source.name == "hand"
        assert source.delivers == "truth"
        assert source.rate_hz == 200.0
        assert source.n_frames == 1
        assert source.skin.n_taxels == 2
        ((stamp, forces),) = source
        assert stamp == 0
        np.testing.assert_array_equal(forces, [[1, 4, 0]])
        assert source.clipped.n == 1

    @pytest.mark.parametrize("delivers", ["truth", "taxels"])
    def test_a_sensor_has_a_topic_of_the_truth_where_there_is_one(
        self, module, delivers
    ):
        hand = module(self.BODY.replace('"truth"', f'"{delivers}"')) + ":Hand"
        sensor = Sensor(SensorSettings(source=hand), Context("sensor", ManualClock()))
        assert sensor.unused == ("/skin/truth",) * (delivers == "taxels")
        for source, known in (
            ("scene:path_40", True),
            ("file:a.npy", False),
            (hand, True),
        ):
            assert (
                "/skin/truth" in Sensor.outputs(SensorSettings(source=source))
            ) == known

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("4.0", "2.0", r"f_max = 4\.0 is stated, .* skin has 2\.0"),
            ('"truth"', '"noise"', "delivers = 'noise'; allowed are truth, taxels"),
            ("n_frames = 1", "n_frames = 1.5", "n_frames = '1.5'"),
            (
                "def __iter__",
                "def frames",
                "returned Hand; expected a generator or an iterable",
            ),
        ],
    )
    def test_attributes_that_cannot_hold_are_refused(self, module, old, new, message):
        name = module(self.BODY.replace(old, new))
        with pytest.raises(SourceError, match=message):
            opened(f"{name}:Hand", f_max=4, unit="N")


class TestName:
    @pytest.mark.parametrize(
        ("target", "message"),
        [
            *(
                (t, "expected module:callable")
                for t in ("", "frames", "a_module:", ":frames")
            ),
            ("no_such_skin:frames", "there is no module 'no_such_skin'"),
        ],
    )
    def test_what_is_not_module_and_callable_is_refused(self, target, message):
        with pytest.raises(SourceError, match=message):
            opened(target)
        with pytest.raises(SettingsError, match="f_max: nan is outside"):
            opened("a_skin:frames", f_max=float("nan"))

    @pytest.mark.parametrize(
        ("body", "message"),
        [
            (
                "def frame():\n    yield 0, [[1.0]]",
                r"has no 'frames' \(did you mean 'frame'\?",
            ),
            ("frames = 3", "is int, which cannot be called"),
            ("def frames():\n    yield 0, np.zeros((0, 3))", "an item holds 0 numbers"),
            (
                "def frames():\n    yield 0, np.ones((1, 2), int)",
                "whole numbers, .*; add unit=c",
            ),
            ("def frames():\n    yield from ()\n", "ended before its first frame"),
            ("def frames(port):\n    yield", "the driver failed: TypeError: .*'port'"),
            (
                "def frames():\n    raise OSError('no\\nport')",
                "failed: OSError: no port",
            ),
            ("raise SystemExit(3)", "importing it failed: SystemExit: 3"),
        ],
    )
    def test_what_is_no_driver_is_refused(self, module, body, message):
        with pytest.raises(SourceError, match=message):
            opened(module(body) + ":frames")


def test_a_frame_is_a_copy_of_what_was_delivered():
    delivered = np.ones((3, 4), np.float32)
    address = DriverAddress("skin:frames", Layout(f_max=2.5))
    ((_, forces),) = driver.DriverSource(address, [(0, delivered)])
    assert not np.shares_memory(forces, delivered)
    np.testing.assert_array_equal(forces, delivered)

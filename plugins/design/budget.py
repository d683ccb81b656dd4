"""The budget of each strategy: time of each stage, the rate that is reached, bytes, accuracy."""

import math
from dataclasses import dataclass

from sparseskin.messages.quantised import n_bytes
from sparseskin.nodes.compressor.change import FALSE_SENDS
from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.plugins.edge.description import CRC_BYTES, HEADER_BYTES

from .models import HOP_S, LARGEST, cost
from .spec import Design
from .strategies import ANALOG, DIGITAL, LARGER, STRATEGIES, Strategy

STAGES = ("ADC", "edge", "bus", "host")
"""Stages that a frame passes; each works on a frame while the one before it has the next."""
QUIET_S = 0.5
"""Longest silence of a skin at rest, as of `compressor.quiet`. Chosen: that of the documents."""
NO_GRID = ("N/4 sums of rows", "N/4 sums of 16 x 16")
"""Strategies that need a grid: rows of columns, or neighbourhoods of cells."""


@dataclass(frozen=True)
class Accuracy:
    """Mean PSNR of contact frames, peak f_max, dB; ends of the band of 90 % of the scenes; least
    force a taxel, as a part of the range, at which a touch of 3 x 3 taxels is found within 8 frames
    in 90 % of cases. NaN: not simulated, or none is found.
    """

    psnr_db: float
    low_db: float
    high_db: float
    light_touch: float


UNKNOWN = Accuracy(math.nan, math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Row:
    """A strategy on a skin: measurements, wires, conversions and bytes of a frame on the bus, with
    header and checksum of the project's edge; bytes a second while nothing changes, NaN where the
    edge cannot tell; time in each of `STAGES`, seconds (of the host for
    one core under a dense press; `host_calm_s`: where nothing presses); frames a second of all
    cores of the host; rate asked for; full scale, newtons; accuracy at the rate that is reached;
    parts of the skin that the host reconstructs by themselves.
    """

    strategy: Strategy
    m: int
    lines: int
    conversions: int
    n_bytes: int
    rest_bytes_s: float
    stage_s: dict[str, float]
    host_calm_s: float
    host_rate_hz: float
    asked_hz: float
    range_n: float
    accuracy: Accuracy = UNKNOWN
    patches: int = 1

    @property
    def stage_hz(self) -> dict[str, float]:
        """Frames a second that each stage can process."""
        # The host has several cores, and so a rate of its own.
        rates = {name: 1 / self.stage_s[name] for name in STAGES[:-1]}
        return {**rates, "host": self.host_rate_hz}

    @property
    def limit(self) -> str:
        """The slowest stage."""
        return min(STAGES, key=self.stage_hz.__getitem__)

    @property
    def possible_hz(self) -> float:
        """Rate of the slowest stage, frames a second."""
        return self.stage_hz[self.limit]

    @property
    def reached_hz(self) -> float:
        """Frames a second: those asked for, or fewer."""
        return min(self.asked_hz, self.possible_hz)

    @property
    def is_met(self) -> bool:
        """True if the rate that is asked for is reached."""
        return self.possible_hz >= self.asked_hz

    @property
    def light_touch_n(self) -> float:
        """Least force a taxel, N, at which a press of 3 x 3 taxels is found; NaN if not known."""
        return self.accuracy.light_touch * self.range_n

    @property
    def latency_s(self) -> float:
        """Time from a frame's first conversion to its reconstruction, dense press, without
        queues.
        """
        return sum(self.stage_s.values()) + HOP_S

    @property
    def host_cores(self) -> float:
        """Cores of the host that are busy at the rate that is reached, under a dense press."""
        return self.reached_hz * self.stage_s["host"] * self.patches


def budget(design: Design) -> list[Row]:
    """Return the row of each strategy that is possible on the skin."""
    rows = []
    for name, strategy in STRATEGIES.items():
        # Sums along rows and columns need a grid.
        if design.n_rows is not None or name not in NO_GRID:
            rows.append(row_of(strategy, design))
    return rows


def row_of(strategy: Strategy, design: Design) -> Row:
    """Return the row of one strategy. The stages overlap, as a frame is converted while the one
    before it is sent: the rate is that of the slowest, the latency the sum of all.
    """
    n = design.n_taxels
    m = strategy.m(n, design.n_rows)
    n_wires, conversions = wires_of(strategy, design)
    sent_bytes = frame_bytes(strategy, design)
    n_sums = 0 if strategy.reads_single else m

    # A large skin is several patches of equal size.
    patches = -(-n // LARGEST)
    host = cost(strategy.name, -(-n // patches))
    stage_s = {
        "ADC": design.adc.seconds(conversions),
        "edge": design.edge.seconds(strategy.name, n, conversions, n_sums, sent_bytes),
        "bus": design.bus.seconds(sent_bytes),
        "host": host.dense_s,
    }
    # A patch is reconstructed by one core: more cores than patches are idle.
    n_busy_cores = min(design.cores, patches)
    host_rate_hz = n_busy_cores / (host.dense_s * patches)
    return Row(
        strategy=strategy,
        m=m,
        lines=n_wires,
        conversions=conversions,
        n_bytes=sent_bytes,
        rest_bytes_s=rest_bytes_s(strategy, design),
        stage_s=stage_s,
        host_calm_s=host.calm_s,
        host_rate_hz=host_rate_hz,
        asked_hz=design.rate_hz,
        range_n=design.range_n,
        patches=patches,
    )


def rest_bytes_s(strategy: Strategy, design: Design) -> float:
    """Bytes a second that a compressor with `quiet` sends at rest: a cycle of rows in each silence,
    and false sends. NaN where the edge does not read all taxels, in which it would see a change.
    """
    n = design.n_taxels
    m = strategy.m(n, design.n_rows)
    _, conversions = wires_of(strategy, design)
    if conversions < n and strategy.phi != LARGER:
        return math.nan
    # In each silence all rows are sent once, so that the host knows the whole skin.
    cycle = 1
    if strategy.rows == ROTATING:
        cycle = -(-n // m)
    asked_s = cycle / QUIET_S
    in_vain_s = FALSE_SENDS * design.rate_hz
    frames_s = min(design.rate_hz, asked_s + in_vain_s)
    return frames_s * frame_bytes(strategy, design)


def wires_of(strategy: Strategy, design: Design) -> tuple[int, int]:
    """Wires that leave the skin or end in an amplifier on it, and conversions of a frame. An array
    has a wire a row and column, analog sums of SBHE one a taxel. Of points, the array is the
    smallest near square; so is that of larger taxels in the shape of the skin.
    """
    n = design.n_taxels
    # Who builds the skin chooses how it sums; other kinds have one way.
    sums = design.sums if strategy.phi == "sbhe" else strategy.sums
    conversions = strategy.m(n, design.n_rows)
    # Digital sums are of readings that were converted before.
    if sums == DIGITAL or strategy.phi == "full":
        conversions = n
    # Each taxel has a wire of its own to the amplifiers.
    if sums == ANALOG and strategy.phi != "row_local":
        return n, conversions

    n_rows = design.n_rows
    n_cols = design.n_cols
    if strategy.phi == LARGER and n_rows is not None and n_cols is not None:
        # As many along both sides as their number and the shape of the skin allow.
        n_rows_in_shape = round(math.sqrt(conversions * n_rows / n_cols))
        n_rows = min(conversions, max(1, n_rows_in_shape))
        return n_rows + -(-conversions // n_rows), conversions

    # Points: the smallest near square that holds them, fewer where they are larger.
    if strategy.phi == LARGER:
        n = conversions
    if n_rows is None or n_cols is None:
        n_rows = math.isqrt(n - 1) + 1
        n_cols = -(-n // n_rows)
    return n_rows + n_cols, conversions


def frame_bytes(strategy: Strategy, design: Design) -> int:
    """Bytes of a frame on the bus: header and checksum of the edge's frames, 15; M numbers without
    gaps, of the converter's bits if they are readings, else of the design's; of "adaptive" the
    choice too, at most 2 bits for each of the about N / 3 nodes of its tree.
    """
    n = design.n_taxels
    bits = design.adc.bits if strategy.reads_single else design.bits
    n_payload = n_bytes(strategy.m(n, design.n_rows), bits)
    n_choice = 0
    if strategy.phi == "adaptive":
        n_choice = n_bytes(-(-n // 3), 2)
    return HEADER_BYTES + CRC_BYTES + n_payload + n_choice

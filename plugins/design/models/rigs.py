"""Skins that were built, and what the models of this study predict for them."""

from __future__ import annotations

from dataclasses import dataclass

from .adc import Adc
from .buses import Bus, Can, Serial, Spi

WITHIN = 2.0
"""Factor within which a prediction is to be."""


@dataclass(frozen=True)
class Rig:
    """A skin that was built.

    Attributes
    ----------
    name : str
    reads : str
        What it reads.
    conversions : int
        Conversions of a frame.
    adc : Adc or None
        Its converters; None where they are left out.
    n_bytes : int
        Bytes of a frame on its bus; 0 where nothing is sent while it measures.
    bus : Bus or None
    published_hz : float
        Rate that is published, or measured by its users.
    facts : str
        Where each number comes from.
    reason : str
        Why prediction and rate differ by more than a factor 2, or what the prediction leaves open.
    """

    name: str
    reads: str
    conversions: int
    adc: Adc | None
    n_bytes: int
    bus: Bus | None
    published_hz: float
    facts: str
    reason: str = ""

    @property
    def stage_hz(self) -> dict[str, float]:
        """Frames a second of each stage that is modelled."""
        found = {}
        if self.adc is not None:
            found["ADC"] = 1 / self.adc.seconds(self.conversions)
        if self.bus is not None:
            found["bus"] = 1 / self.bus.seconds(self.n_bytes)
        return found

    @property
    def limit(self) -> str:
        """The slowest stage."""
        return min(self.stage_hz, key=self.stage_hz.__getitem__)

    @property
    def predicted_hz(self) -> float:
        """Frames a second that the models predict."""
        return self.stage_hz[self.limit]

    @property
    def ratio(self) -> float:
        """Predicted over published rate."""
        return self.predicted_hz / self.published_hz

    @property
    def is_within(self) -> bool:
        """True if the prediction is within a factor 2."""
        return 1 / WITHIN <= self.ratio <= WITHIN


_AVR_FAST = Adc(10, 16e6 / 16 / 13)
"""ADC of an ATmega328P at 16 MHz with prescaler 16: 13 ADC clocks a conversion, 76.9 kS/s.
Source: Atmel-8271, ADC, prescaling and conversion timing."""
_TEENSY_4 = Adc(10, 1 / 20e-6)
"""analogRead of a Teensy 4 with the default mean of four conversions: 20 us, as a user measured.
Source: PJRC forum, thread 57683, of 12 bits."""
_SPTS = Adc(10, 1 / 5e-6, settling_s=11e-6)
"""analogRead of a Teensy 4 without averaging, a quarter of 20 us, after 11 us of settling.
Source: that thread; clkItv and analogReadAveraging(0) in Transmitter_Code.ino of aslepyan/SPTS."""

RIGS = (
    Rig(
        "FlexiTac, bus alone",
        "16 x 32, all",
        512,
        None,
        514,
        Serial(2e6),
        389.0,
        "514 bytes a frame at 2 Mbaud: firmware 32_16_fast.ino of FlexiTac_Hardware_Repo; the rate "
        "is what its bytes allow, not a measurement",
    ),
    Rig(
        "FlexiTac",
        "16 x 32, all",
        512,
        _AVR_FAST,
        514,
        Serial(2e6),
        100.0,
        "ADC prescaler 16 in 32_16_fast.ino; ATmega328P data sheet; about 100 Hz: pull request 4 "
        "of FlexiTac_Hardware_Repo",
        "its loop waits for each conversion, then sends and shifts: 6.5 us more a taxel would "
        "explain it",
    ),
    Rig(
        "3D-ViTac",
        "16 x 16, all",
        256,
        _AVR_FAST,
        802,
        Serial(2e6),
        32.0,
        "MatrixArray.ino of 3D-ViTac_Tactile_Hardware: prescaler 16, 2 Mbaud, numbers as text "
        "(about 3 characters each, 2 a line); 32 Hz: 3D-ViTac, arXiv 2410.24091",
        "not explained by ADC and bus: the loop of the published file has a pause of 20 ms, "
        "commented out, with which the models give 42 Hz; converting numbers to text is not "
        "modelled",
    ),
    Rig(
        "ACTS, raster",
        "32 x 32, all",
        1024,
        _TEENSY_4,
        0,
        None,
        55.0,
        "Subsampling_HS.ino of CompressiveTactileSubsampling: analogRead with its defaults, one "
        "taxel after the other, sent after the run; 55 Hz: ACTS, arXiv 2410.13847",
    ),
    Rig(
        "ACTS, M = 64",
        "64 of 32 x 32",
        64,
        _TEENSY_4,
        0,
        None,
        887.0,
        "as above; 887 Hz: ACTS, arXiv 2410.13847",
    ),
    Rig(
        "SPTS, 7 % of 100",
        "7 sums of 100",
        7,
        _SPTS,
        0,
        None,
        3500.0,
        "Transmitter_Code.ino of aslepyan/SPTS: 11 us, then one reading a sum; 3500 Hz and 7 %: "
        "SPTS, arXiv 2511.16898",
        "the article's summary does not say with how many sums 3500 Hz were reached; the models "
        "give 3500 Hz at 18 sums, 8900 Hz at the 7 % that it states for finding a contact",
    ),
    Rig(
        "fabric array",
        "8192, all",
        256,
        Adc(12, 1e6),
        2 * 8192,
        Spi(10e6),
        50.0,
        "8000 taxels on daisy-chained SPI, 16 rows a board, an SPI converter on each (so 32 boards "
        "of 16 x 16 at once), more than 50 Hz: arXiv 2508.20959. Assumed: 16 bits a reading, SPI "
        "at 10 MHz, 1 MS/s",
        "the clock of the bus is assumed: 50 Hz need at least 6.6 MHz",
    ),
    Rig(
        "iCub, torso",
        "768 slots, all",
        12,
        Adc(16, 12 / 36.864e-3),
        64 * 2 * 8,
        Can(1e6),
        20.0,
        "4 boards of 16 triangles of 12 values, two CAN messages a triangle, 1 Mbit/s, period "
        "50 ms: robotology/robots-configuration (iCubGenova02, torso), iCub documentation of "
        "physical sensors; converter AD7147: 36.9 ms for 12 values at decimation 256 (data sheet, "
        "table 10), all triangles at once",
        "the period is configured; at decimation 64 the converter allows 108 Hz, and the bus 58 Hz",
    ),
)
"""Rigs, in the order of the table."""

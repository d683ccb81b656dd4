"""The sensor node of a batch of equal patches: simulated ones, or one recording for each."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sparseskin.messages import Message, MessageError, SkinState, TaxelsBatch, TruthBatch, topic_of
from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.batch import batch_topic, check_patches
from sparseskin.nodes.errors import SettingsError, SourceError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.node import Context, SourceNode, Tick
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.settings import PatchSettings, naming, setting

from .noise import NoiseModel
from .points import point_skins
from .scenes.scenes import SCENES, open_scene
from .scenes.tiled import TILED, TiledScene
from .source import DEFAULT_RATE_HZ
from .sources import SCENE

MAX_TAXELS = MAX_ELEMENTS
"""Most cells of all patches of a batch: those of one array of a message."""


@dataclass(frozen=True)
class SensorBatchSettings(PatchSettings):
    """Settings of the sensor node of a batch."""

    patches: tuple[str, ...] = setting(
        (), "names of the patches served, all with the same skin; patch is the name of their batch"
    )
    source: str = setting(
        "scene:lying",
        "scene of a body (scene:lying, scene:hug, scene:walk), or of a patch, which all then show",
        decides=True,
    )
    rate_hz: float = setting(
        DEFAULT_RATE_HZ,
        "frames a second; 0: as fast as its subscribers process them",
        low=0.0,
        high=100_000.0,
        live=True,
    )
    duration_s: float | None = setting(
        None, "time after which a scene of a body ends, in seconds; without end if not stated",
        low=0.001, high=1e9,
    )  # fmt: skip
    active: float | None = setting(
        None, "part of the patches that are pressed in a period, in place of the scene's",
        low=0.0, high=1.0,
    )  # fmt: skip
    seed: int = setting(0, "seed of the scene and of the noise", low=0, high=2**32 - 1)
    noise: float = setting(1.0, "noise in multiples of the skin's", low=0.0, high=100.0, live=True)
    n_rows: int = setting(64, "rows of a patch, for a scene of a body", low=1, high=4096)
    n_cols: int = setting(64, "columns of a patch, for a scene of a body", low=1, high=4096)
    pitch_mm: float = setting(5.0, "distance of taxels in millimetres", low=0.01, high=1000.0)
    f_max: float = setting(PAPER_F_MAX_N, "upper end of the range in N", low=1e-9, high=1e9)
    mask: tuple[str, ...] | None = setting(
        None, "a text a row, of 1 for each taxel that exists and 0 for others; all if not stated"
    )
    points: str = setting(
        "",
        "file with the places of the taxels of every patch, as of a sensor, in place of n_rows, "
        "n_cols, pitch_mm and mask; a scene of a body then presses their virtual grid",
    )
    sigma_end: float | None = setting(
        None, "noise of an untouched taxel in N; if not stated, the paper's", low=0.0, high=1e9
    )
    sigma_mid: float | None = setting(
        None, "noise at half the range in N; if not stated, sigma_end or the paper's",
        low=0.0, high=1e9,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        check_patches(self.patches)
        n_cells = len(self.patches) * self.n_rows * self.n_cols
        if n_cells > MAX_TAXELS and not self.points:
            raise SettingsError(
                f"patches: {len(self.patches)} of {self.n_rows} x {self.n_cols} are {n_cells} "
                f"cells; at most {MAX_TAXELS} in one batch: use more batches"
            )
        if self.mask is not None:
            bad = [row for row in self.mask if len(row) != self.n_cols or set(row) - {"0", "1"}]
            if len(self.mask) != self.n_rows or bad:
                raise SettingsError(
                    f"mask: expected {self.n_rows} texts of {self.n_cols} characters 0 and 1"
                )

    def check(self) -> None:
        name = self.source.removeprefix(SCENE)
        known = (*TILED, *SCENES)
        if not self.source.startswith(SCENE) or name not in known:
            raise SettingsError(
                f"source: {self.source!r} is not available for a batch"
                f"{nearest_of(name, known)}, after '{SCENE}'"
            )
        if self.points and name in SCENES:
            raise SettingsError(f"points: scene {name} presses a flat grid of its own")
        with naming("points" if self.points else "mask"):
            n_cells = len(self.patches) * math.prod(self.skin().shape)
        if n_cells > MAX_TAXELS:
            raise SettingsError(f"patches: {n_cells} cells; at most {MAX_TAXELS} in one batch")

    def skin(self) -> Skin:
        """The skin of every patch; raises SourceError if it is none."""
        if (name := self.source.removeprefix(SCENE)) in SCENES:
            return open_scene(name, self.seed).skin
        if self.points:
            return point_skins().place(self.points).skin(self.f_max, "N")
        rows = self.mask
        mask = None if rows is None else np.array([[c == "1" for c in row] for row in rows])
        if mask is not None and mask.all():
            mask = None
        try:
            return Skin(self.n_rows, self.n_cols, self.f_max, "N", self.pitch_mm / 1e3, mask)
        except MessageError as error:
            raise SourceError(str(error)) from error


class SensorBatch(SourceNode[SensorBatchSettings]):
    """Publishes /BATCH/skin once, then /BATCH/taxels_batch and /BATCH/truth_batch.

    The next frame is computed before its tick, as that of `Sensor`.
    """

    Settings = SensorBatchSettings

    def __init__(self, settings: SensorBatchSettings, context: Context) -> None:
        super().__init__(settings, context)
        settings.check()
        self.skin = settings.skin()
        self.rate_hz = settings.rate_hz
        self._noise = self._chosen_noise()
        self._rng = context.rng(settings.seed)
        self._n_frames = 0
        self._frames = self._truths()
        self._next: tuple[Floats, Floats] | None = None
        self._prepare()

    @classmethod
    def outputs(cls, settings: SensorBatchSettings) -> tuple[str, ...]:
        schemas = ("skin", "taxels", "truth")
        return tuple(batch_topic(topic_of(settings.patch, schema)) for schema in schemas)

    @classmethod
    def facts(cls, settings: SensorBatchSettings) -> Mapping[str, Any]:
        return {topic_of(settings.patch, SkinState.schema): settings.skin().n_taxels}

    def start(self) -> Iterable[Message]:
        yield self._describe()

    def change(self, settings: SensorBatchSettings) -> Iterable[Message]:
        new_pace = settings.rate_hz != self.settings.rate_hz
        self.settings = settings
        self._noise = self._chosen_noise()
        if self._next is not None:
            self._next = self._measured(self._next[1])  # it was computed with the noise before
        if new_pace:
            self.rate_hz = settings.rate_hz
            self.begin(self.context.clock.now_ns())
        yield self._describe()

    def tick(self, tick: Tick) -> Iterable[Message]:
        if self._next is None:
            return
        taxels, truth = self._next
        same: dict[str, Any] = {
            "stamp_ns": tick.stamp_ns,
            "patch": self.settings.patch,
            "names": self.settings.patches,
        }
        yield TaxelsBatch(**same, forces=taxels)
        yield TruthBatch(**same, forces=truth)
        self._n_frames += 1
        self._watch_rate(tick.stamp_ns)
        self._prepare()

    def state(self) -> dict[str, Any]:
        return {**super().state(), "rate_hz": self.rate_hz}

    def status(self) -> str:
        name = self.settings.source.removeprefix(SCENE)
        return f"{name}: frame {self._n_frames} of {len(self.settings.patches)} patches"

    def _describe(self) -> SkinState:
        s = self.settings
        return SkinState(
            stamp_ns=self.context.clock.now_ns(),
            patch=s.patch,
            **vars(self.skin),
            source=s.source.removeprefix(SCENE),
            seed=s.seed,
            rate_hz=self.rate_hz,
            has_truth=True,
            sigma_mid=self._noise.sigma_mid,
            sigma_end=self._noise.sigma_end,
        )

    def _chosen_noise(self) -> NoiseModel:
        s, paper = self.settings, NoiseModel.for_range(self.skin.f_max)
        end = paper.sigma_end if s.sigma_end is None else s.sigma_end
        mid = s.sigma_mid
        if mid is None:
            mid = paper.sigma_mid if s.sigma_end is None else end
        return NoiseModel(self.skin.f_max, s.noise * mid, s.noise * end)

    def _truths(self) -> Iterator[Floats]:
        """True forces of all patches, (n_patches, n_rows, n_cols), a frame at a time."""
        s = self.settings
        n_patches, name = len(s.patches), s.source.removeprefix(SCENE)
        if name in SCENES:
            for _, forces in open_scene(name, s.seed):
                yield np.repeat(forces[None], n_patches, axis=0)
            return
        scene = TiledScene(name, self.skin, n_patches, s.active, s.seed)
        t_s = 0.0
        while s.duration_s is None or t_s < s.duration_s:
            yield scene.forces(t_s)
            t_s += 1.0 / (self.rate_hz or DEFAULT_RATE_HZ)

    def _prepare(self) -> None:
        """Compute the next frame, or note that there is none."""
        truth = next(self._frames, None)
        self._next = None if truth is None else self._measured(truth)
        self.exhausted = truth is None

    def _measured(self, truth: Floats) -> tuple[Floats, Floats]:
        """Readings of true forces, and these."""
        taxels = self._noise.apply(truth, self._rng)
        if self.skin.mask is not None:
            taxels[:, ~self.skin.mask] = 0.0
        return taxels, truth

"""The recogniser: labels each frame of a patch by a model."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sparseskin.messages import (
    Labels,
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    topic_of,
)
from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.nodes.errors import RefusedError, SettingsError
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.settings import PatchSettings, naming, setting

from .models import READS, check_name, load_model

NEWEST = 1
"""Messages that may wait: a label of an older frame is of no use where a newer one is there."""


@dataclass(frozen=True)
class RecogniserSettings(PatchSettings):
    """Settings of the recogniser node."""

    model: str = setting(
        "model.joblib",
        'the model: "module:Class", or a joblib file, which is code: yours only, from nobody else',
    )
    reads: str = setting(
        READS[0],
        "topic that it reads; of measurements with fixed rows alone",
        choices=READS,
    )
    least: float = setting(
        0.5,
        "share below which a frame has no label",
        low=0.0,
        high=1.0,
        live=True,
    )

    def check(self) -> None:
        """Raise SettingsError if the model is not there; it is not read here."""
        with naming("model"):
            check_name(self.model)


class Recogniser(Node[RecogniserSettings]):
    """Reads /PATCH/reconstruction or /PATCH/measurements and publishes /PATCH/labels."""

    Settings = RecogniserSettings
    required = False

    def __init__(self, settings: RecogniserSettings, context: Context) -> None:
        super().__init__(settings, context)
        with naming("model"):
            self._model = load_model(settings.model)
        trained_on = getattr(self._model, "reads", "")
        if trained_on and trained_on != settings.reads:
            raise SettingsError(
                f"reads: the model was trained on {trained_on}, state that"
            )
        self._labels = [str(label) for label in self._model.classes_]
        # A user's own class need not state what it was trained on.
        self._n_inputs: int | None = getattr(self._model, "n_features_in_", None)
        self._phi: str = getattr(self._model, "phi", "")
        self._label = ""
        self._since_ns: int | None = None
        self._n_frames = 0
        self._counts: dict[str, int] = {}

    @property
    def depth(self) -> int:
        # Played faster than live, every frame is labelled; 0 stands for no limit.
        return NEWEST if self.context.live else 0

    @classmethod
    def inputs(cls, settings: RecogniserSettings) -> tuple[str, ...]:
        schemas = [settings.reads]
        if settings.reads == Measurements.schema:
            schemas.insert(0, PhiState.schema)
        return tuple(topic_of(settings.patch, schema) for schema in schemas)

    @classmethod
    def outputs(cls, settings: RecogniserSettings) -> tuple[str, ...]:
        return (topic_of(settings.patch, Labels.schema),)

    def step(self, message: Message) -> Iterable[Message]:
        """Label one frame. Raises RefusedError if the model is not of its numbers."""
        if isinstance(message, PhiState):
            # Refused at once: each frame would mean something else.
            if message.rows == ROTATING:
                raise SettingsError(
                    "rows of the compressor rotate, so that measurements mean something else in "
                    'each frame: set its rows = "fixed", or reads = "reconstruction"'
                )
            return
        values = self._values(message)

        # The age begins anew where the label changes.
        label, share = self._recognised(values)
        if self._since_ns is None or label != self._label:
            self._label = label
            self._since_ns = message.stamp_ns

        self._n_frames += 1
        self._counts[label] = self._counts.get(label, 0) + 1
        yield Labels(
            stamp_ns=message.stamp_ns,
            patch=message.patch,
            label=label,
            share=share,
            # Stamps go back where a recording is played again.
            age_s=max(0, message.stamp_ns - self._since_ns) / 1e9,
            done_ns=self.context.clock.now_ns(),
            trusted=not isinstance(message, Reconstruction) or message.trusted[0],
        )

    def _values(self, message: Message) -> Floats:
        """Inputs of the model, float32 (1, d)."""
        assert isinstance(message, Reconstruction | Measurements)
        if message.names:
            raise RefusedError(
                f"{message.topic}: holds several patches; a recogniser reads one"
            )
        # Measurements of another matrix are as many numbers, and would be labelled without a sign.
        if self._phi and message.phi != self._phi:
            raise RefusedError(
                f"{message.topic}: made by Phi {message.phi}, but the model was trained on "
                f"{self._phi}: set the same phi, m, seed and rows as then"
            )

        array = message.forces if isinstance(message, Reconstruction) else message.y
        values = np.asarray(array, dtype=np.float32).reshape(1, -1)
        if self._n_inputs is not None and values.shape[1] != self._n_inputs:
            raise RefusedError(
                f"{message.topic}: {values.shape[1]} numbers, but the model was trained on "
                f"{self._n_inputs}"
            )
        return values

    def _recognised(self, values: Floats) -> tuple[str, float]:
        """Label and its share; no label where all numbers are 0, or the share is too small."""
        # An untouched skin has no label, whatever the model would answer.
        if not values.any():
            return "", 0.0
        try:
            (shares,) = np.asarray(self._model.predict_proba(values), dtype=np.float64)
        except Exception as error:
            raise RefusedError(
                f"model {self.settings.model}: {one_line(error)}"
            ) from error
        # A model of the user's may return anything.
        if shares.shape != (len(self._labels),) or not np.isfinite(shares).all():
            raise RefusedError(
                f"model {self.settings.model}: expected {len(self._labels)} finite shares"
            )

        best = int(shares.argmax())
        share = float(np.clip(shares[best], 0, 1))
        label = ""
        if share >= self.settings.least:
            label = self._labels[best]
        return label, share

    def state(self) -> dict[str, Any]:
        return {"label": self._label}

    def report(self) -> dict[str, Any]:
        return {"frames": self._n_frames, "labels": dict(sorted(self._counts.items()))}

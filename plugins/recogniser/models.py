"""Models of a recogniser: a class of the user's, or a joblib file that he has trained himself.

A joblib file is code: reading one runs whatever it holds. So it is read where a setting names it,
if it belongs to the user and nobody else can write it, and never from a recording or a message.
"""

import os
import stat
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sparseskin.messages.frames import Measurements, Reconstruction
from sparseskin.messages.labels import MAX_LABEL
from sparseskin.nodes.errors import SettingsError, not_installed
from sparseskin.nodes.lookup import find_callable, one_line
from sparseskin.nodes.numerics.arrays import Doubles, Floats

SUFFIX = ".joblib"
READS = (Reconstruction.schema, Measurements.schema)
"""Topics that a model may read."""
OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class Model(Protocol):
    """A model, as scikit-learn has classifiers; it may also have `n_features_in_`, the number of
    its inputs, `reads`, one of `READS`, and `phi`, the fingerprint of its Phi.
    """

    classes_: np.ndarray[Any, Any]
    """Labels, (k,)."""

    def predict_proba(self, inputs: Floats) -> Doubles:
        """Shares of the labels, (n, k), of inputs (n, d): forces row by row, or measurements."""


def check_name(name: str) -> None:
    """Raise SettingsError unless this names a class, or a joblib file that is the user's own."""
    if not name.endswith(SUFFIX):
        if ":" not in name:
            raise SettingsError(
                f'{name!r}: expected "module:Class", or a file {SUFFIX} of yours'
            )
        return

    try:
        # The owner is looked at before the file is opened: to read it is to run it.
        state = os.stat(name)
    except OSError as error:
        raise SettingsError(f"{name}: {error.strerror}") from error
    if not stat.S_ISREG(state.st_mode):
        raise SettingsError(f"{name}: is no file")
    # Root may write any file anyway, so that its own are no further risk.
    if state.st_uid not in (os.getuid(), 0) or state.st_mode & OTHERS_WRITE:
        raise SettingsError(
            f"{name}: others can write it, and a joblib file is code: chmod go-w if it is yours"
        )


def load_model(name: str) -> Model:
    """The model of a setting: an object of "module:Class", or what a joblib file holds.

    Raises SettingsError, one line, if it cannot be had, or is no model.
    """
    check_name(name)
    if name.endswith(SUFFIX):
        model = _unpickled(Path(name))
    else:
        made_by = find_callable(name, SettingsError)
        try:
            model = made_by()
        except Exception as error:
            raise SettingsError(f"{name}: {one_line(error)}") from error

    # What scikit-learn's classifiers have is asked for, and no class of it.
    predicts = callable(getattr(model, "predict_proba", None))
    if not predicts or not hasattr(model, "classes_"):
        kind = type(model).__name__
        raise SettingsError(
            f"{name}: {kind} has no predict_proba and classes_, as models have"
        )
    # Labels are printed on terminals and pages of others.
    labels = [str(label) for label in np.asarray(model.classes_).ravel()]
    for label in labels:
        if not label.isprintable() or len(label) > MAX_LABEL:
            quoted = repr(label[:MAX_LABEL])
            raise SettingsError(
                f"{name}: label {quoted}; allowed: at most {MAX_LABEL} printable "
                "characters"
            )
    checked: Model = model
    return checked


def _unpickled(path: Path) -> Any:
    """What a joblib file holds; `check_name` has been called."""
    try:
        # The only place where a file is unpickled: the user has named it, and it is his.
        import joblib  # noqa: TID251
    except ImportError as error:
        fault = not_installed("joblib", "tasks")
        raise SettingsError(f"{path}: {fault}") from error
    try:
        return joblib.load(path)
    except Exception as error:
        # Whatever the classes in the file raise.
        raise SettingsError(
            f"{path}: no model can be read: {one_line(error)}"
        ) from error

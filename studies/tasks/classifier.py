"""The classifier of study `tasks` and of trained recognisers: kernel ridge regression."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sparseskin.nodes.errors import SparseskinError, not_installed
from sparseskin.nodes.numerics.arrays import Doubles, Floats

GRID = {"gamma": (0.3, 1.0, 3.0, 10.0), "alpha": (1e-3, 1e-2, 1e-1)}
"""Widths of the kernel and weights of the ridge that are tried, of inputs of unit norm. Chosen:
distances of such inputs are 0 to 2."""
SEARCHED = 600
"""Examples of the training set, at most, on which the constants are chosen. Chosen: the search then
takes less time than the training."""
FOLDS = 3
"""Parts of the training set in the cross-validation of `GRID`."""


def check_installed(asker: str) -> None:
    """Raise SparseskinError if scikit-learn is not installed; `asker` is named in the line."""
    if find_spec("sklearn") is None:
        raise SparseskinError(f"{asker}: {not_installed('scikit-learn', 'tasks')}")


class Classifier:
    """Labels, and other figures, of vectors of numbers: kernel ridge regression on all at once.

    Each input is divided by its norm: forces of another size look the same. The targets are 1 for
    the label and 0 for all others, so that outputs estimate the probability of each label, and the
    figures as they are. Width and weight are chosen by cross-validation of the training set.

    Attributes
    ----------
    classes_ : ndarray, shape (k,)
        Labels that it knows, sorted; set by `fit`.

    Notes
    -----
    Kernel ridge regression: Saunders, Gammerman, Vovk, ICML (1998); by scikit-learn. Least squares
    on indicators estimates their conditional mean: Hastie, Tibshirani, Friedman, "The Elements of
    Statistical Learning", 2nd ed., section 4.2.
    """

    def __init__(self) -> None:
        self.classes_: np.ndarray[Any, Any] = np.empty(0)
        self.n_features_in_ = 0
        self._model: Any = None

    def fit(
        self, inputs: Floats, labels: ArrayLike, figures: Doubles | None = None
    ) -> Classifier:
        """Train on inputs (n, d), their n labels, and further figures (n, f); returns itself.

        Raises SparseskinError if there are fewer than `FOLDS` inputs or 2 labels.
        """
        from sklearn.kernel_ridge import KernelRidge
        from sklearn.model_selection import GridSearchCV, KFold

        self.classes_, numbers = np.unique(np.asarray(labels), return_inverse=True)
        if len(inputs) < FOLDS or self.classes_.size < 2:
            text = f"{len(inputs)} examples of {self.classes_.size} labels"
            raise SparseskinError(
                f"{text}; needed are {FOLDS} or more, of 2 labels or more"
            )
        self.n_features_in_ = inputs.shape[1]
        targets = np.eye(self.classes_.size)[numbers]
        if figures is not None:
            targets = np.hstack([targets, figures])

        scaled = _of_unit_norm(inputs)
        # The constants on a part of the examples, the model on all of them.
        searched = np.random.default_rng(0).permutation(len(inputs))[:SEARCHED]
        folds = KFold(FOLDS, shuffle=True, random_state=0)
        search = GridSearchCV(KernelRidge(kernel="rbf"), GRID, cv=folds, refit=False)
        search.fit(scaled[searched], targets[searched])
        self._model = KernelRidge(kernel="rbf", **search.best_params_).fit(
            scaled, targets
        )
        return self

    def predict_proba(self, inputs: Floats) -> Doubles:
        """Share of each label, 0..1 and of sum 1: (n, k), of inputs (n, d)."""
        return self.predict_all(inputs)[0]

    def predict_all(self, inputs: Floats) -> tuple[Doubles, Doubles]:
        """Shares as of `predict_proba`, and figures (n, f)."""
        outputs = self._model.predict(_of_unit_norm(inputs))
        n_labels = self.classes_.size
        shares = np.clip(outputs[:, :n_labels], 1e-6, None)
        return shares / shares.sum(axis=1, keepdims=True), outputs[:, n_labels:]


def _of_unit_norm(inputs: Floats) -> Doubles:
    """Inputs (n, d), each divided by its norm; those of 0 stay 0."""
    norms = np.linalg.norm(inputs, axis=1, keepdims=True)
    scaled: Doubles = inputs / np.maximum(norms, 1e-12)
    return scaled

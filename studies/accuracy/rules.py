"""Each rule of the default solver and of the search for faults switched off: what gets worse."""

from __future__ import annotations

import importlib
import math
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import pandas as pd

from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.skin.tuning import SkinTuning
from sparseskin.studies.harness import Candidate
from sparseskin.studies.points import compute_rows
from sparseskin.studies.stability.tables import FAR_FROM_READING, RESIDUE
from sparseskin.studies.stability.verdicts import GOOD, judge
from sparseskin.studies.stability.worlds import SIDES, draw_world

from .constants import UNCHANGED, changes, figures

OFF = 1e30
"""Value of a constant that is beyond all others."""
SKIN = "sparseskin.nodes.reconstructor.skin"
FAULTS = "sparseskin.nodes.reconstructor.faults"
SENSOR = "sparseskin.nodes.sensor"


def _always(value: Any) -> Any:
    """An attribute of a class that keeps a value, whatever its instances set."""
    return property(lambda self: value, lambda self, _: None)


@dataclass(frozen=True)
class Rule:
    """A rule in words, and what switches it off: fields of `SkinTuning`, and attributes of modules
    or classes by module and name.
    """

    does: str
    tuning: Mapping[str, float] = field(default_factory=dict)
    patches: Mapping[tuple[str, str], Any] = field(default_factory=dict)

    @property
    def switch(self) -> str:
        """What switches it off, in one line."""
        fields = [f"{name} = {value:g}" for name, value in self.tuning.items()]
        names = [f"{module.rsplit('.', 1)[1]}.{name}" for module, name in self.patches]
        return ", ".join([*fields, *names])


def _constant(does: str, **tuning: float) -> Rule:
    """A rule that fields of `SkinTuning` switch off."""
    return Rule(does, tuning)


def _patched(does: str, *patches: tuple[str, str, Any]) -> Rule:
    """A rule that other values of attributes switch off."""
    return Rule(
        does, patches={(module, name): value for module, name, value in patches}
    )


RULES: dict[str, Rule] = {
    "falling damping": _constant(
        "later steps of a frame are smaller", damped_from=1000
    ),
    "weights by residuals": _constant(
        "estimates of steps count by their residuals", residual_power=0
    ),
    "rise": _constant("later steps count more", rise_power=0),
    "least error of z": _constant(
        "the error variance of z is a part of the residual at least", least_tau=0
    ),
    "bound of alpha": _constant(
        "the denoiser's expected error is bounded in the iteration", most_alpha=0.9999
    ),
    "motion of the prediction": _constant(
        "the last estimate is moved and scaled", motion=OFF
    ),
    "ridge of the motion": _constant("energies of the motion have a ridge", ridge=0),
    "least measurements of a motion": _constant(
        "few measurements show no motion", least_read=0
    ),
    "mean of the noise": _constant(
        "the noise level is averaged over frames", noise_rate=1
    ),
    "bound of the noise's growth": _constant(
        "the noise level grows by a factor per frame at most", noise_growth=OFF
    ),
    "growth where all is read": _constant(
        "the bound does not hold where nearly all rows are read", all_read=OFF
    ),
    "bound by the least noise": _constant(
        "the noise level is bounded by the least one and the pressed part",
        pressed_noise=OFF,
    ),
    "louder": _constant(
        "what exceeds the least noise is no noise of a skin", louder=OFF
    ),
    "significance": _constant(
        "an excess counts as far as noise does not explain it", significant=1e-6
    ),
    "mean of the prediction's error": _constant(
        "the error of the prediction is averaged over frames", signal_rate=1
    ),
    "dependent errors": _constant(
        "errors of a prediction count as dependent on each other", prior=1, doubt=0
    ),
    "filters of the rows": _constant(
        "each row remembers its measurements", most_recalled=0
    ),
    "recall": _constant(
        "a regression finds the part of the filters' correction that counts",
        recall_ridge=OFF,
    ),
    "memory of the recall": _constant(
        "that regression keeps past frames", recall_memory=0
    ),
    "motion of the filters": _constant(
        "means of the filters move as the prediction does", most_confirmed=0
    ),
    "memory of their motion": _constant(
        "its regressions keep past frames", motion_memory=0
    ),
    "blend with the prediction": _constant(
        "the estimate is a mean of the steps and the prediction", blend=OFF
    ),
    "trust in the noise": _constant(
        "the noise level counts less where the estimate lags behind", lagging=OFF
    ),
    "least trust": _constant("that trust has a least value", least_trust=1e-9),
    "bias": _constant("the mean of clipped noise is subtracted", most_bias=0),
    "first rate of the bias": _constant(
        "the bias is learned faster at first", bias_begins=0
    ),
    "growth of the least noise": _constant(
        "the least noise so far is forgotten slowly", bias_forgotten=1
    ),
    "optimism": _constant("estimates err more than the gates expect", optimism=1),
    "silence": _constant(
        "after silence, a noise that is not stated is doubted", silence_kept=0
    ),
    "unexplained residual": _constant(
        "an untouched skin has a residual of noise alone",
        unexplained=OFF,
        unresolved=OFF,
    ),
    "unresolved residual": _constant(
        "the same more strictly, where the noise is stated", unresolved=OFF
    ),
    "untouched": _constant(
        "weak forces are trusted as those of an untouched skin", untouched=0
    ),
    "error of the estimate": _constant("a large error is not trusted", trusted=OFF),
    "doubt of measurements": _constant(
        "measurements that no force explains are doubted", outlying=OFF
    ),
    "sums of blocks": _patched(
        "sums of blocks are not compared with other rows",
        (f"{SKIN}.row_subset", "HEAVY", OFF),
    ),
    "what stands out": _patched(
        "tiles in which nothing stands out of the noise are 0",
        (f"{SKIN}.standing_out", "STANDS_OUT", (1e-6,) * 4),
    ),
    "repeated measurements": _patched(
        "a measurement that repeats exactly counts once",
        (f"{SKIN}.estimator", "REPEATED", 0.0),
    ),
    "repeats and silence": _patched(
        "frames that repeat or are 0 beside others show nothing new",
        (f"{SKIN}.row_subset", "_nothing_of", lambda value, scale: 0.0),
    ),
    "errors of rows left out": _patched(
        "errors are estimated by rows that are left out of their own values",
        (f"{SKIN}.trust", "Fit.distance2", property(lambda fit: fit.settled.residual2)),
    ),
    "mean of the error's share": _constant(
        "the part of errors in the residual is averaged over frames", share_rate=1
    ),
    "confirmation": _constant(
        "a stated error counts so far as new rows confirm it", belief=1e30
    ),
    "errors of repeats": _patched(
        "repeats lower errors at most as other measurements would",
        (f"{SKIN}.trust", "StatedError._n_repeats", _always(0.0)),
    ),
    "missing noise": _patched(
        "the noise that the residual lacks is an error of the estimate",
        (f"{SKIN}.trust", "TaxelNoise.missing", _always(0.0)),
    ),
    "constant and clipped frames": _patched(
        "frames whose measurements share a value are marked",
        (f"{FAULTS}.repeats", "least_ties", lambda m, is_quantised: m + 1),
    ),
    "frozen frames": _patched(
        "frames that repeat exactly are marked", (f"{FAULTS}.repeats", "FRAMES", OFF)
    ),
    "repeating measurements": _patched(
        "a measurement that repeats alone does not count",
        (f"{FAULTS}.repeats", "RepeatWatch.faulty", _always(None)),
    ),
    "offset": _patched(
        "an offset of all measurements is subtracted",
        (f"{FAULTS}.offset", "SIGNIFICANT", math.inf),
    ),
    "stuck taxels": _patched(
        "the sensor finds taxels that repeat their readings",
        (f"{SENSOR}.doubt.repeats", "Repeats.reason", lambda self, *_, **__: ""),
    ),
    "neighbours of stuck taxels": _patched(
        "those beside them fill them in",
        (f"{SENSOR}.doubt.repeats", "Repeats.filled", lambda self, forces: forces),
    ),
    "range": _patched(
        "forces beyond the range are marked", (f"{FAULTS}.watch", "BEYOND", OFF)
    ),
}
"""Rules by name."""
OWN_FAULTS = {
    "louder": "loud noise",
    "silence": "zeros",
    "unexplained residual": "loud noise",
    "unresolved residual": "hum of measurements",
    "error of the estimate": "one-sided converter",
    "doubt of measurements": "garbage for ever",
    "sums of blocks": "garbage at times",
    "repeated measurements": "frozen measurements",
    "repeats and silence": "frames of zeros",
    "constant and clipped frames": "all equal",
    "frozen frames": "frozen measurements",
    "repeating measurements": "stuck measurements",
    "offset": "offset",
    "stuck taxels": "stuck taxels",
    "neighbours of stuck taxels": "stuck rows or columns",
    "range": "scaled up",
}
"""Kind of fault that a rule is for, of which it has worlds of its own."""

N_WORLDS = 60
QUICK_WORLDS = 2
"""Drawn worlds without a fault, and as many with one."""
N_OWN = 12
QUICK_OWN = 1
"""Those of the fault of a rule."""
WORLD_SIDES = (8, 10, 12, 16, 20, 24)
"""Sides of their skins: small ones take less time. Those of the fault of a rule are all of `SIDES`:
small skins have too few blocks for some rules."""

_PATCHING = threading.Lock()
"""Attributes of modules are those of all threads."""


class Column(NamedTuple):
    """A column of the table: format of its changes; least change that counts, below 0 where less is
    worse. Chosen: about twice what rules without an effect on a column change it by.
    """

    spec: str
    counts_from: float


COLUMNS = {
    "error, rotating rows, %": Column("+z.1f", 2.0),
    "error, fixed rows, %": Column("+z.1f", 2.0),
    "moving, dB": Column("+z.2f", -0.2),
    "sudden, dB": Column("+z.2f", -0.2),
    "wrong, %": Column("+z.2f", 0.2),
    "silent, %": Column("+z.2f", 0.1),
    "false alarms, %": Column("+z.2f", 0.2),
    "estimates close, %": Column("+z.2f", -1.0),
    "estimates low, %": Column("+z.2f", 1.0),
    "far, worlds": Column("+.0f", 1.0),
    "force stays, worlds": Column("+.0f", 1.0),
    "wrong with faults, %": Column("+z.2f", 0.3),
    "silent with faults, %": Column("+z.2f", 0.2),
    "false alarms with faults, %": Column("+z.2f", 0.3),
    "wrong with its fault, %": Column("+z.1f", 1.0),
    "silent with its fault, %": Column("+z.1f", 1.0),
    "false alarms with its fault, %": Column("+z.1f", 1.0),
}
COUNTS = {
    "wrong": "wrong",
    "silent": "silent",
    "alarms": "false alarms",
}
"""Counts of `Verdict`, and their names in columns."""
NOTHING = "nothing"


@contextmanager
def switched_off(rule: Rule) -> Iterator[SkinTuning]:
    """Switch a rule off; yield the constants of the solver without it, which solvers use."""
    tuning = SkinTuning(**rule.tuning)  # type: ignore[arg-type]
    patches = {(f"{SKIN}.solver", "SkinTuning"): lambda: tuning, **rule.patches}
    with _PATCHING, ExitStack() as stack:
        for (module, name), value in patches.items():
            target: Any = importlib.import_module(module)
            *owners, attribute = name.split(".")
            for owner in owners:
                target = getattr(target, owner)
            # Attributes of instances are none of their class.
            stack.enter_context(
                patch.object(target, attribute, value, create=bool(owners))
            )
        yield tuning


def candidates() -> dict[str, Candidate]:
    """The default solver without each rule that its constants switch off."""
    return {
        name: Candidate({**PRESETS["skin"], "tuning": dict(rule.tuning)})
        for name, rule in RULES.items()
        if rule.tuning
    }


def points(n_worlds: int, n_own: int, seed: int) -> list[dict[str, Any]]:
    """Drawn worlds without and with a fault, each with all rules and without each of them; and
    those of `OWN_FAULTS`.
    """
    of_all = [
        {
            "rule": name,
            "seed": 1000 * seed + k,
            "has_fault": has_fault,
        }
        for k in range(n_worlds)
        for has_fault in (False, True)
        for name in (UNCHANGED, *RULES)
    ]
    # Of the fault that a rule is for: with all rules, and without this one.
    of_its_fault = [
        {
            "rule": name,
            "seed": 1000 * seed + k,
            "has_fault": True,
            "fault": OWN_FAULTS[rule],
        }
        for k in range(n_own)
        for rule in OWN_FAULTS
        if rule in RULES
        for name in (UNCHANGED, rule)
    ]
    return of_its_fault + of_all


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Verdict on a drawn world without a rule."""
    fault = point.get("fault", "")
    sides = SIDES if fault else WORLD_SIDES
    world = draw_world(point["seed"], point["has_fault"], fault=fault, sides=sides)
    rule = RULES.get(point["rule"], Rule("all rules"))
    with switched_off(rule), np.errstate(all="ignore"):
        verdict = judge(world)
    is_still = world.load.motion == "still" and world.rows == ROTATING
    return {
        **vars(verdict),
        "is_still": is_still,
        "fault": fault,
    }


def worlds(out: Path, executor: str, quick: bool, seed: int) -> pd.DataFrame:
    """Verdicts on `points`."""
    n_worlds = N_WORLDS
    n_own = N_OWN
    if quick:
        n_worlds = QUICK_WORLDS
        n_own = QUICK_OWN
    asked = points(n_worlds, n_own, seed)
    rows = pd.DataFrame(compute_rows(measure, asked, out, executor, "rules"))
    # Two rules may be for one fault: its worlds with all rules are the same.
    rows = rows.drop_duplicates(["rule", "seed", "has_fault", "fault"])
    return rows.drop(columns="reasons").astype({"error": float, "reading": float})


def figures_of_worlds(rows: pd.DataFrame) -> pd.DataFrame:
    """Figures of `worlds`, a line a rule: shares of their frames in %, and numbers of worlds."""
    rows = rows[rows["fault"] == ""]
    columns = []
    for has_fault, ending in ((False, ""), (True, " with faults")):
        columns.append(_shares(rows[rows["has_fault"] == has_fault], ending))

    sound = rows[~rows["has_fault"]]
    sums = sound.groupby("rule")[["close", "low", "estimated"]].sum()
    for name in ("close", "low"):
        share = 100 * sums[name] / sums["estimated"]
        columns.append(share.rename(f"estimates {name}, %"))
    is_far = sound["is_still"] & (sound["reading"] < GOOD)
    # An estimate that is no number is far, too.
    is_far &= ~(sound["error"] <= FAR_FROM_READING * sound["reading"])
    columns.append(is_far.groupby(sound["rule"]).sum().rename("far, worlds"))
    stays = ~(sound["residue"] <= RESIDUE)
    columns.append(stays.groupby(sound["rule"]).sum().rename("force stays, worlds"))
    return pd.concat(columns, axis=1)


def _shares(rows: pd.DataFrame, ending: str) -> pd.DataFrame:
    """Parts of the frames of some worlds in %, a line a rule; `ending`: of their columns."""
    sums = rows.groupby("rule", sort=False)
    shares = 100 * sums[list(COUNTS)].sum().div(sums["frames"].sum(), axis=0)
    return shares.rename(
        columns={of: f"{name}{ending}, %" for of, name in COUNTS.items()}
    )


def changes_of_worlds(rows: pd.DataFrame) -> pd.DataFrame:
    """Changes of the figures of `worlds` without each rule; also of those of its own fault."""
    figures = figures_of_worlds(rows)
    changes = figures - figures.loc[UNCHANGED]
    changes_of_own = []
    for name in OWN_FAULTS.keys() & RULES.keys():
        of_fault = rows[rows["fault"] == OWN_FAULTS[name]]
        shares = _shares(of_fault, " with its fault")
        without_rule = shares.loc[[name]]
        changes_of_own.append(without_rule - shares.loc[UNCHANGED])
    return pd.concat([changes, pd.concat(changes_of_own)], axis=1)


def table(scores: pd.DataFrame, of_worlds: pd.DataFrame) -> pd.DataFrame:
    """Figures with all rules, and a line a rule: their changes without it, and what gets worse.

    `scores`: rows of `candidates` and of the default, as `constants.figures` takes them;
    `of_worlds`: those of `worlds`.
    """
    of_scores = figures(scores)
    in_worlds = figures_of_worlds(of_worlds)
    base = pd.concat([of_scores.loc[UNCHANGED], in_worlds.loc[UNCHANGED]])
    made = pd.concat([changes(of_scores), changes_of_worlds(of_worlds)], axis=1)

    lines = [
        {
            "rule": UNCHANGED,
            "off by": "",
            "its fault": "",
        }
    ]
    lines[0] |= {key: f"{base[key]:.3g}" for key in COLUMNS if key in base}
    for name, rule in RULES.items():
        line = {
            "rule": name,
            "off by": rule.switch,
            "its fault": OWN_FAULTS.get(name, ""),
        }
        for key, column in COLUMNS.items():
            change = made.loc[name, key]
            line[key] = "-" if pd.isna(change) else format(change, column.spec)
        lines.append({**line, "what gets worse": worse(made.loc[name])})
    return pd.DataFrame(lines).fillna("")


def worse(of_rule: pd.Series) -> str:
    """The columns that are worse without a rule, the worst first."""
    ratios = {key: of_rule[key] / column.counts_from for key, column in COLUMNS.items()}
    worst = sorted(
        (key for key in ratios if ratios[key] >= 1), key=lambda key: -ratios[key]
    )
    if not worst:
        return NOTHING
    return "; ".join([f"**{worst[0]}**", *worst[1:]])

"""The row `plants` of `strangers.py`: multipliers of machines in MuJoCo that the package has not
seen, by perturbed returns and by experiments, against `plants_truth.py`."""

import json
import sys
from typing import Any

import numpy as np
import plants_truth as truth
from scipy import stats

import hybridjax as hj


# Multipliers of this modulus or more are compared: smaller ones matter to nobody.
_COMPARED = 0.05


def quantile(multiplier: complex, dof: float) -> float:
    """Return the distance in standard errors that 95 % of estimates have at most."""
    if multiplier.imag == 0:
        return float(stats.t.ppf(0.975, min(dof, 1e6)))
    # (A standard error of a pair is that of both parts together.)
    return float(np.sqrt(stats.f.ppf(0.95, 2, max(min(dof, 1e6) - 1, 1))))


def compared(fit: Any, true: truth.Truth) -> list[dict[str, Any]]:
    """Return a row for each true multiplier that is compared: the nearest one of the fit, and the
    distance in standard errors of both."""
    rows = []
    for z, error in zip(true.multipliers, true.errors, strict=True):
        if abs(z) < _COMPARED or z.imag < 0:
            continue
        row: dict[str, Any] = {"true": [z.real, z.imag], "error": error}
        if len(fit.multipliers):
            k = int(np.argmin(np.abs(fit.multipliers - z)))
            found = complex(fit.multipliers[k])
            own = float(fit.standard_errors[k])
            off = abs(found - z) / np.hypot(own, error)
            row |= {
                "found": [found.real, found.imag],
                "own": own,
                "off": off,
                "held": bool(off <= quantile(z, fit.covariance_dof)),
            }
        rows.append(row)
    return rows


def plant_of(setting: truth.Setting) -> Any:
    """Return the plant, read in steps of 0.01 s."""
    machine = truth.MACHINES[setting.machine]

    def control(model: Any, data: Any) -> list[float]:
        try:
            return machine.control(model, data)
        except ValueError as fall:
            raise hj.errors.ComputationError(str(fall)) from None

    return hj.plants.MuJoCoPlant(
        setting.model(),
        {"push": "N"},
        control=control,
        period=machine.period,
        substeps=round(0.01 / setting.step),
    )


def returns_of(setting: truth.Setting, true: truth.Truth) -> dict[str, Any]:
    """Return how the default call fares: "held", "said" or "SILENT", and its numbers."""
    try:
        cycle = hj.plants.find_cycle(
            plant_of(setting), hj.ClockPhase(8), ("x_rate", "pitch"), cycles=60
        )
        fit = cycle.perturbed_returns()
    except hj.errors.HybridJaxError as refusal:
        return {"outcome": "said", "says": [str(refusal)], "rows": []}
    rows = compared(fit, true)
    for row in rows:
        # (Not listed: right, if it may be as large as the bound.)
        if not abs(complex(*row.get("found", (0, 0)))) or not row["held"]:
            row["below"] = abs(complex(*row["true"])) <= fit.bound
    says = [repr(finding) for finding in fit.findings]
    held = all(row.get("held") or row.get("below") for row in rows)
    outcome = "held" if held else ("said" if says else "SILENT")
    return {
        "outcome": outcome,
        "says": says,
        "rows": rows,
        "bound": fit.bound,
        "travels": list(fit.travelling),
    }


def experiments_of(
    setting: truth.Setting, true: truth.Truth, amplitude: float
) -> dict[str, Any]:
    """Return how a fit to experiments fares whose order is that of the multipliers above 0.02."""
    order = int((np.abs(true.multipliers) > 0.02).sum())
    says = []
    try:
        cycle = hj.plants.find_cycle(
            plant_of(setting), hj.ClockPhase(8), ("x_rate", "pitch"), cycles=60
        )
        design = hj.multisine(n_sections=8, periods=16, amplitude=amplitude)
        data = cycle.run_experiments(design, processes=0)
        says = [repr(finding) for finding in data.findings]
        fit = hj.fit_multipliers(hj.estimate_htf(data), order=order)
    except hj.errors.HybridJaxError as refusal:
        return {"outcome": "said", "says": [*says, str(refusal)], "rows": []}
    says += [repr(finding) for finding in fit.findings]
    rows = compared(fit, true)
    held = all(row["held"] for row in rows)
    outcome = "held" if held else ("said" if says else "SILENT")
    return {"outcome": outcome, "says": says, "rows": rows}


def pushes(draws: int) -> None:
    """Print how the regions of experiments with four sizes of inputs fare in so many settings."""
    totals: dict[str, int] = {}
    default = [truth.Setting(machine) for machine in truth.MACHINES]
    for setting in [*default, *truth.settings(draws)][:draws]:
        try:
            true = truth.truth_of(setting)
        except ValueError as fall:
            print(json.dumps({"setting": repr(setting), "no truth": str(fall)}))
            continue
        for amplitude in (0.3, 0.1, 0.03, 0.01):
            found = experiments_of(setting, true, amplitude)
            totals[found["outcome"]] = totals.get(found["outcome"], 0) + 1
            found |= {"setting": repr(setting), "amplitude": amplitude}
            print(json.dumps(found), flush=True)
    print(f"{sum(totals.values())} fits: {totals}", flush=True)


def plants(draws: int) -> None:
    """Print how the regions of perturbed returns fare in so many settings."""
    totals: dict[str, int] = {}
    counts = [0, 0]
    for setting in truth.settings(draws):
        try:
            true = truth.truth_of(setting)
        except ValueError as fall:
            print(json.dumps({"setting": repr(setting), "no truth": str(fall)}))
            continue
        found = returns_of(setting, true)
        totals[found["outcome"]] = totals.get(found["outcome"], 0) + 1
        for row in found["rows"]:
            if "held" in row and not (row.get("below") and not row["held"]):
                counts[0] += row["held"]
                counts[1] += 1
        found |= {"setting": repr(setting), "decay": true.by_decay}
        print(json.dumps(found), flush=True)
    held, n = counts
    p = stats.binomtest(held, n, 0.95).pvalue if n else 1.0
    print(f"{sum(totals.values())} settings: {totals}; multipliers in their regions:")
    print(f"{held} of {n}, p of 95 %: {p:.2g}")
    sys.stdout.flush()

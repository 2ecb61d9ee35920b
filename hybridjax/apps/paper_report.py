"""The report of `reproduce`: numbers (`summarize`), the paper's observations, a table (`table`).

Nothing is estimated here; each observation compares numbers of the results of `reproduce.py` with a
statement of the paper. If a number is wrong, look at the fit it is read from; if an observation is,
at its `_about_...`.

A further observation is a function `_about_...` that `_observations` calls. The bounds in these
functions say when a statement of the paper counts as confirmed, and must not follow the results.
`table` reads the summary by its keys, and so may users (`summary.json`): keys must stay.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from .. import __version__
from .._core.results import Result
from ..orbits.cycle import LimitCycle


OUTPUTS = ("yM", "vM")


def summarize(protocol: Any, cycle: LimitCycle, families: Mapping[str, Any]) -> dict:
    """Return every number of the table, ready for JSON."""
    true = cycle.multipliers
    summary: dict[str, Any] = {
        "version": __version__,
        "protocol": dataclasses.asdict(protocol),
        "limit_cycle": {
            "period": float(cycle.period),
            "residual": float(cycle.residual),
            "multipliers": complex_pairs(true),
        },
        "families": {},
    }
    for name, family in families.items():
        biases = [
            family.rational_exact.compare(true, name).max_error for name in OUTPUTS
        ]
        errors = family.estimate.harmonic_errors(
            family.ldtp.htf(family.estimate.frequencies)
        )
        at = {m: k for k, m in enumerate(family.estimate.harmonics)}
        results = family.structured.result, *np.ravel(family.rational.result)
        summary["families"][name] = {
            "experiments": family.experiments,
            "converged": all(x == Result.OK for x in results),
            "multipliers_from_linearization": complex_pairs(family.ldtp.multipliers),
            "multipliers_fit_structured": complex_pairs(family.structured.multipliers),
            "multipliers_fit_structured_error": family.structured.compare(
                true
            ).max_error,
            "multipliers_fit_2p1z": {
                output: {
                    "multipliers": complex_pairs(family.rational.multipliers[k]),
                    "error": family.rational.compare(true, k).max_error,
                    "error_of_the_same_fit_to_the_exact_htf": biases[k],
                    "poles": complex_pairs(family.rational.poles[k]),
                    "zeros": complex_pairs(family.rational.zeros[k]),
                }
                for k, output in enumerate(OUTPUTS)
            },
            "htf_error_of_max_H_0": {
                output: {
                    f"H_{m}": float(errors[at[m], k])
                    for m in (-2, -1, 0, 1, 2)
                    if m in at
                }
                for k, output in enumerate(OUTPUTS)
            },
        }
    summary["observations"] = _observations(families)
    return summary


def _observations(families: Mapping[str, Any]) -> list[dict]:
    """Return the paper's observations (Secs. VI-C1 to C3), each with the values measured here."""
    observations = [*_about_phases(families["isochron"], families["kinematic"])]
    for name, family in families.items():
        observations += [
            _about_bumps(name, family),
            _about_higher_harmonics(name, family),
            _about_fits(name, family),
        ]
    exact = next(iter(families.values())).ldtp.multipliers
    text = ", ".join(f"{z:.6f}" for z in exact)
    text += ": with the paper's parameters the real part is negative, the printed sign was lost"
    printed = 0.25 + np.array([0.7j, -0.7j])
    holds = np.all(np.abs(exact - printed) < 1e-2)
    observations.append(_noted("the multipliers are 0.25 +- 0.70j", holds, text))
    return observations


def _noted(claim: str, holds: Any, measured: str) -> dict:
    return {"claim": claim, "holds": bool(holds), "measured": measured}


def _largest(family: Any, m: int) -> np.ndarray:
    """Return the largest |H_m| of each output."""
    modulus = np.abs(np.asarray(family.estimate[m])[:, :, 0])
    return modulus.max(axis=0)


def _about_phases(isochron: Any, kinematic: Any) -> Iterator[dict]:
    """Compare the two choices of the phase."""
    ratio = _largest(isochron, 0) / _largest(kinematic, 0)
    yield _noted(
        "the gain of H_0 is doubled with isochrons",
        np.all((ratio > 1.6) & (ratio < 2.5)),
        f"max|H_0| isochron / kinematic: {_pairs(ratio)}",
    )
    a = isochron.rational
    b = kinematic.rational
    apart = np.abs(np.sort_complex(a.poles) - np.sort_complex(b.poles))
    moved = np.max(apart, axis=1)
    yield _noted(
        "the choice of phase leaves the poles where they are",
        np.all(moved < 1e-3),
        f"distance of the fitted poles in z: {_pairs(moved)}",
    )
    moved = np.max(np.abs(a.zeros - b.zeros), axis=1)
    yield _noted(
        "the choice of phase moves the zeros",
        np.any(moved > 1e-2),
        f"distance of the fitted zeros in z: {_pairs(moved)}",
    )


def _about_bumps(name: str, family: Any) -> dict:
    """Look for local maxima of |H_0| around f = 2."""
    from scipy.signal import find_peaks  # (half a second)

    f = np.asarray(family.exact.frequencies)
    H_0 = np.asarray(family.exact[0])[:, :, 0]
    size = np.log(np.abs(H_0))
    has_bumps = []
    places = []
    for k, output in enumerate(OUTPUTS):
        maxima, _ = find_peaks(size[:, k], prominence=0.01)
        peaks = f[maxima]
        peaks = peaks[(peaks > 1.5) & (peaks < 2.5)]
        has_bumps.append(len(peaks) > 0)
        listed = ", ".join(f"{x:.3g}" for x in peaks) or "none"
        places.append(f"{listed} ({output})")
    text = f"local maxima of |H_0| for f in (1.5, 2.5): {'; '.join(places)}"
    return _noted(f"{name}: bumps of H_0 around f = 2", any(has_bumps), text)


def _about_higher_harmonics(name: str, family: Any) -> dict:
    """Compare the second harmonics, and all beyond the first, with the others."""
    H = np.asarray(family.estimate.H)[..., 0]
    power = np.sum(np.abs(H) ** 2, axis=1)
    order = np.abs(np.array(family.estimate.harmonics))
    total = power.sum(axis=0)
    to_first = power[order <= 1].sum(axis=0) / total
    to_second = power[order <= 2].sum(axis=0) / total
    second = np.maximum(_largest(family, 2), _largest(family, -2))
    second = second / _largest(family, 0)
    text = (
        f"max|H_+-2| / max|H_0|: {_pairs(second)}; part of the sum of |H_m|^2 with "
        f"|m| <= 1: {_pairs(to_first)}, with |m| <= 2: {_pairs(to_second)}"
    )
    claim = f"{name}: |H_m| is negligible for |m| >= 2"
    return _noted(claim, np.all(second < 0.1), text)


def _about_fits(name: str, family: Any) -> dict:
    """Compare the eigenvalues of the fits with the exact ones."""
    true = family.ldtp.multipliers
    errors = [family.rational.compare(true, k).max_error for k in OUTPUTS]
    claim = (
        f"{name}: eigenvalues from the fits are right up to the third significant digit"
    )
    return _noted(claim, max(errors) < 5e-3, f"|error|: {_pairs(errors)}")


def table(summary: dict) -> str:
    """Return the summary as text."""
    true = complex(*summary["limit_cycle"]["multipliers"][0])
    rows = ["", "Floquet multipliers", f"  {'':38}{'lambda':>28}  |error|"]
    rows.append(f"  {'Jacobian of the return map':38}{true:>28.9f}")

    def row(label, values, error=None):
        z = min((complex(*pair) for pair in values), key=lambda z: abs(z - true))
        error = abs(z - true) if error is None else error
        rows.append(f"  {label:38}{z:>28.9f}  {error:.1e}")

    for name, family in summary["families"].items():
        row(f"product of A[n], {name}", family["multipliers_from_linearization"])
        for output, fit in family["multipliers_fit_2p1z"].items():
            row(f"2 poles 1 zero, {name}, {output}", fit["multipliers"], fit["error"])
            bias = fit["error_of_the_same_fit_to_the_exact_htf"]
            rows.append(
                f"  {'    the same fit to the exact H_0':38}{'':28}  {bias:.1e}"
            )
        error = family["multipliers_fit_structured_error"]
        row(f"structured, {name}", family["multipliers_fit_structured"], error)
    rows += [
        "",
        "Largest error of the estimated HTF, relative to max|H_0| of the output",
    ]
    for name, family in summary["families"].items():
        for output, errors in family["htf_error_of_max_H_0"].items():
            sizes = "  ".join(f"{m}: {e:.1e}" for m, e in errors.items())
            rows.append(f"  {name:10} {output:4} {sizes}")
    rows += [
        "",
        "Observations of the paper",
    ]
    for item in summary["observations"]:
        found = "confirmed" if item["holds"] else "differs"
        rows.append(f"  {found:9}  {item['claim']}")
        rows.append(f"             {item['measured']}")
    if not all(item["holds"] for item in summary["observations"]):
        rows += [
            "",
            "'differs' means that this statement of the paper does not hold for its own model, as "
            "computed here.",
            "The reproduction has not failed: docs/paper-errata.md explains each difference.",
        ]
    time = f"Time: {summary['seconds']:.1f} s."
    return "\n".join([*rows, "", time, ""])


def complex_pairs(values) -> list[list[float]]:
    """Return real and imaginary parts, as JSON holds them."""
    flat = np.asarray(values).ravel()
    return [[float(z.real), float(z.imag)] for z in flat]


def _pairs(values) -> str:
    return ", ".join(
        f"{v:.3g} ({name})" for name, v in zip(OUTPUTS, values, strict=True)
    )

"""Estimates from data of strangers: generators that do not import the package.

Each row is a command. It prints a table with the number of draws and p-values.

    python benchmarks/strangers.py files    # recordings and files with something wrong
    python benchmarks/strangers.py groups   # false alarms between maps of two groups
    python benchmarks/strangers.py bands    # simultaneous bands of means of skewed maps
    python benchmarks/strangers.py series   # fit_ldtp of series with other noise than its model
    python benchmarks/strangers.py phase    # phase response curves from times of events
    python benchmarks/strangers.py phase-long  # the same of four times as many
    python benchmarks/strangers.py loops    # fit_series and fit_ldtp where a reference is known
    python benchmarks/strangers.py weak     # fit_series of a pair beside a weak multiplier
    python benchmarks/strangers.py distortion  # rhythms that respond a little nonlinearly
    python benchmarks/strangers.py study    # studies whose data support a lower order
    python benchmarks/strangers.py natural  # multipliers of rhythms that nobody perturbs
    python benchmarks/strangers.py plants   # machines in MuJoCo with other contacts and time steps
    python benchmarks/strangers.py pushes   # experiments on them, with four sizes of inputs

`--draws` sets the number of draws, `--short` a tenth of it (about a minute for each row).
"""

import argparse
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import one_thread


one_thread.pin()

import numpy as np  # noqa: E402
import strangers_beats as beats  # noqa: E402
import strangers_dirt as dirt  # noqa: E402
import strangers_distortion as weakly  # noqa: E402
import strangers_plants  # noqa: E402
import strangers_truth as truth  # noqa: E402
from scipy import stats  # noqa: E402

import hybridjax as hj  # noqa: E402


# Standard errors beyond which an answer without a word is wrong.
_WRONG = 5.0
# Findings of phase responses that say how wide a band is: they name no reason why it is wrong.
_OF_WIDTH = {"resolution", "wide", "slow input", "shape"}
# Findings of recordings that name no reason why a multiplier may be wrong.
_OF_BAND = {"band", "narrow excitation"}
# Part of the phases at which a band of 95 % holds, below which it is missed.
_MISSED = 0.9


def identified(
    trials: list[dirt.Trial], sections: str
) -> tuple[complex, float, list[str]]:
    """Return the multiplier, its standard error and all that is said."""
    recordings = []
    for k, trial in enumerate(trials):
        signals = {
            name: x for name, x in trial.items() if name not in ("time", "strike")
        }
        recordings.append(
            hj.Recording(
                trial["time"], signals, events={"strike": trial["strike"]}, name=f"t{k}"
            )
        )
    cycle: hj.AtEvent | hj.Crossing = hj.AtEvent("strike")
    if sections == "trigger":
        cycle = hj.Crossing("trigger", "rising", 2.5)
    result = hj.identify_recording(
        hj.Recording.join(recordings), cycle, "u", ("x", "y"), order=1, n_sections=8
    )
    said = [repr(x) for x in result.diagnosis.findings]
    fit = result.fit
    return complex(fit.multipliers[0]), float(fit.standard_errors[0]), said


def of_recording(kind: dirt.Kind, seed: int, true: float) -> tuple[str, str]:
    """Return "right", "named", "said" or "SILENT", and a text."""
    rng = np.random.default_rng(seed)
    trials = kind.soil(dirt.clean(seed), rng)
    try:
        multiplier, error, said = identified(trials, kind.sections)
    except hj.errors.HybridJaxError as refusal:
        text = str(refusal)
        named = bool(kind.words) and bool(re.search(kind.words, text))
        return ("named" if named else "said"), text
    text = "; ".join(said)
    if kind.words and re.search(kind.words, text):
        return "named", text
    off = abs(multiplier - true) / error
    value = f"{multiplier:.3f}, {off:.1f} standard errors off; {text}"
    if off < _WRONG:
        return "right", value
    return ("said" if said else "SILENT"), value


def of_file(kind: dirt.FileKind, seed: int) -> tuple[str, str]:
    """Return the same of a file."""
    trial = dirt.clean(seed, (0.35,))[0]
    with tempfile.TemporaryDirectory() as folder:
        try:
            path = kind.write(Path(folder), trial)
        except ImportError as error:
            return "not run", str(error)
        try:
            found = hj.read_recording(path, signals=kind.signals)
        except hj.errors.HybridJaxError as refusal:
            text = str(refusal)
            named = bool(kind.words) and bool(re.search(kind.words, text))
            return ("named" if named else "said"), text
    text = "; ".join(map(repr, found.findings))
    if kind.words and re.search(kind.words, text):
        return "named", text
    names = [name for name in found.signals if name.split(".")[0] == "y"]
    values = found[names[0]] if names else np.zeros(0)
    right = len(values) == len(trial["y"]) and np.allclose(
        values, trial["y"], atol=1e-4, equal_nan=True
    )
    if right:
        return "right", text
    return ("said" if text else "SILENT"), f"{len(values)} samples; {text}"


def files(draws: int) -> None:
    """Print, for each kind of dirt, how often it was named, or the answer right."""
    true = float(np.exp(-0.7))
    totals: dict[str, int] = {}
    print(f"{'kind':36} {'right':>5} {'named':>5} {'said':>5} {'SILENT':>6}")

    def row(name: str, outcomes: list[tuple[str, str]]) -> None:
        counts = {x: 0 for x in ("right", "named", "said", "SILENT", "not run")}
        for outcome, _ in outcomes:
            counts[outcome] += 1
            totals[outcome] = totals.get(outcome, 0) + 1
        numbers = [counts[x] for x in ("right", "named", "said", "SILENT")]
        right, named, said, silent = numbers
        print(f"{name:36} {right:5} {named:5} {said:5} {silent:6}")
        for outcome, text in outcomes:
            if outcome in ("said", "SILENT"):
                print(f"    {outcome}: {text[:300]}")

    for kind in dirt.RECORDINGS:
        row(kind.name, [of_recording(kind, seed, true) for seed in range(draws)])
    for kind in dirt.FILES:
        row(kind.name, [of_file(kind, seed) for seed in range(min(draws, 2))])
    kinds = len(dirt.RECORDINGS) + len(dirt.FILES)
    print(f"{kinds} kinds, {draws} draws: {totals}")


def groups(draws: int) -> None:
    """Print how often maps of two groups with the same mean differ, at a level of 5 %."""
    print("sizes and spreads        values       alarms     n  share  p of 5 %")
    for kind in ("normal", "lognormal"):
        for n, spread, m, other in truth.GROUPS:
            alarms = 0
            table = {"subject": np.arange(n + m), "group": ["a"] * n + ["b"] * m}
            for seed in range(draws):
                rng = np.random.default_rng((seed, n, m))
                y = truth.smooth_maps(rng, n + m)
                if kind == "lognormal":
                    y = np.exp(0.6 * y) - np.exp(0.18)
                y[:n] *= spread
                y[n:] *= other
                maps = hj.recordings.PopulationMaps(
                    table, y, {"phase": np.arange(60) / 60}
                )
                found = maps.difference("a", "b", draws=1000, seed=seed)
                alarms += bool(found.significant.any())
            p = stats.binomtest(alarms, draws, 0.05).pvalue
            design = f"{n} ({spread:g}) and {m} ({other:g})"
            print(
                f"{design:24} {kind:10} {alarms:8} {draws:5} {alarms / draws:6.3f} {p:9.2g}",
                flush=True,
            )


def bands(draws: int) -> None:
    """Print how often the band of a mean of lognormal maps contains it."""
    print("subjects  sigma   held     n  share  p of 95 %")
    for n in (8, 12, 20, 40):
        for size in (0.0, 0.3, 0.6, 1.0):
            held = 0
            for seed in range(draws):
                rng = np.random.default_rng((seed, n))
                y, mean = truth.lognormal_maps(rng, n, size)
                if not size:
                    y, mean = truth.smooth_maps(rng, n), 0.0
                maps = hj.recordings.PopulationMaps(
                    {"subject": np.arange(n)}, y, {"phase": np.arange(60) / 60}
                )
                found = maps.mean(draws=1000, seed=seed)
                held += bool((np.abs(found.values - mean) <= found.reach).all())
            p = stats.binomtest(held, draws, 0.95).pvalue
            share = held / draws
            print(
                f"{n:8} {size:6.1f} {held:6} {draws:5} {share:6.3f} {p:9.2g}",
                flush=True,
            )


def series(draws: int) -> None:
    """Print how often the region of `fit_ldtp` holds, and how often a miss has no finding."""
    head = "data, noise of the fit              held  quiet     n  p of 95 %  findings"
    print(head)
    pair = [0.5 + 0.45j]
    rows = [
        ("white sensors, output", "output", pair, 0.0, 0.0),
        ("noise of states, output", "output", pair, 0.5, 0.0),
        ("noise of states, slow u, output", "output", pair, 0.5, 0.8),
        ("noise of states, innovations", "innovations", pair, 0.5, 0.0),
        ("a multiplier more, output", "output", [*pair, 0.6], 0.0, 0.0),
        ("a multiplier more, innovations", "innovations", [*pair, 0.6], 0.0, 0.0),
    ]
    for name, noise, multipliers, size, color in rows:
        fits = []
        for seed in range(draws):
            data = truth.noisy_series(multipliers, seed, size, color)
            fits.append(_fitted(data, noise))
        _series_row(name, fits)
    fits = []
    for seed in range(draws):
        fits.append(_fitted(truth.controlled_series(seed), "innovations"))
    _series_row("controller at once, innovations", fits)


def _fitted(
    data: tuple[truth.Loop, np.ndarray, np.ndarray], noise: str
) -> tuple[bool, list[str]]:
    """Return whether the region of two dimensions holds the multipliers, and the findings."""
    loop, u, y = data
    N = len(loop.A)
    records = [
        hj.experiments.SectionSeries(a, b, n_sections=N)
        for a, b in zip(u, y, strict=True)
    ]
    fit = hj.fit_ldtp(records, 2, noise=noise)
    holds = bool(fit.contains(loop.multipliers).all())
    return holds, [finding.cause for finding in fit.findings]


def _series_row(name: str, fits: list[tuple[bool, list[str]]]) -> None:
    held = sum(holds for holds, _ in fits)
    quiet = sum(not holds and not causes for holds, causes in fits)
    counts: dict[str, int] = {}
    for _, causes in fits:
        for cause in causes or ["none"]:
            counts[cause] = counts.get(cause, 0) + 1
    p = stats.binomtest(held, len(fits), 0.95).pvalue
    print(f"{name:34} {held:5} {quiet:6} {len(fits):5} {p:10.2g}  {counts}", flush=True)


def study(draws: int) -> None:
    """Print how studies end of whose multipliers the data support fewer, or none at first."""
    print("truth, order, noise          ended as")
    rows = [
        ("2, 2, 3 times the signal", [0.7, 0.3], 2, 3.0),
        ("3, 4, 2 %", [0.6 + 0.3j, 0.3], 4, 0.02),
        ("2, 4, 2 %", [0.7, 0.4], 4, 0.02),
        ("3, 3, 2 %", [0.6 + 0.3j, 0.3], 3, 0.02),
    ]
    for name, multipliers, order, noise in rows:
        ends: dict[str, int] = {}
        for seed in range(draws):
            end = _studied(multipliers, order, noise, seed)
            ends[end] = ends.get(end, 0) + 1
        print(f"{name:28} {ends}", flush=True)


def _studied(multipliers: list[complex], order: int, noise: float, seed: int) -> str:
    """Return how a study of at most six blocks ends."""
    rng = np.random.default_rng(seed)
    loop = truth.loop_with(multipliers, 8, 2, rng)
    first = hj.multisine(8, periods=24, lines="odd", frequencies=(0, 4), seed=seed)
    first = first.scaled(1.0)
    quest = hj.designs.SequentialDesign(first, order=order, standard_error=1e-2)
    size = truth.periodic_response(loop, first.signals()).std(axis=(0, 1))
    for _ in range(6):
        u = quest.design.signals()
        y = truth.periodic_response(loop, u)
        y = y + noise * size * rng.normal(size=y.shape)
        data = hj.experiments.ExperimentData(u, y, n_sections=8, periods=24)
        try:
            quest = quest.add(data)
        except hj.errors.DefinitionError as error:
            right = f"support {len(loop.multipliers)} multipliers, not {order}"
            return "refused, right order" if right in str(error) else str(error)[:60]
        if quest.done:
            fit = quest.fit
            holds = fit is not None and bool(fit.contains(loop.multipliers).all())
            return "done, held" if holds else "done, missed"
    return "not done after 6 blocks, says why" if "since" in repr(quest) else "not done"


def phase(draws: int, size: int = 480) -> None:
    """Print how often bands of phase responses of so many events hold the curve, and what misses
    are named.

    "missed" counts draws whose band holds the truth at less than 90 % of the phases, "5 off" those
    whose curve is beyond five standard errors of it at some phase, and "quiet" those of either
    without a finding that names a reason.
    """
    print(
        "rhythm, input, events                 n finite  in band  mean off  missed quiet  5 off "
        "quiet  CPU s"
    )
    for name, curve in beats.CURVES.items():
        for kind, highest in beats.INPUTS.items():
            made = [
                beats.phase_rhythm(seed, curve, highest, size) for seed in range(draws)
            ]
            _phase_row(f"{name}, {kind}, {size}", made, curve)
    curve = beats.CURVES["one sign"]
    for name, wander, forgotten in (
        ("random walk", 0.02, np.inf),
        ("autoregression", 0.03, 20.0),
    ):
        for kind, highest in beats.INPUTS.items():
            made = [
                beats.phase_rhythm(
                    seed, curve, highest, size, wander=wander, forgotten=forgotten
                )
                for seed in range(draws)
            ]
            _phase_row(f"{name}, {kind}, {size}", made, curve)
    for name, neuron in beats.NEURONS.items():
        curve = neuron.curve()
        for kind, highest in beats.INPUTS.items():
            made = [
                beats.neuron_beats(seed, neuron, curve, highest, size)
                for seed in range(draws)
            ]
            _phase_row(f"{name}, {kind}, {size}", made, curve)


def long_phase(draws: int) -> None:
    """Print the same of 2000 events."""
    phase(draws, 2000)


def _phase_row(name: str, draws: list[beats.Beats], truth: np.ndarray) -> None:
    shares = []
    means = []
    causes: dict[str, int] = {}
    finite = 0
    # Of all, and of those without a reason.
    missed = np.zeros(2, int)
    wrong = np.zeros(2, int)
    start = time.process_time()
    for made in draws:
        found = _phase_response(made)
        low, high = found.interval(beats.PHASE)
        error = (high - low) / 4
        finite += bool(np.isfinite(error).all())
        share = np.mean((low <= truth) & (truth <= high))
        shares.append(share)
        size = np.sqrt(found.covariance[0, 0])
        means.append((found.values.mean() - truth.mean()) / size)
        said = [x.cause for x in found.findings if x.cause != "resolution"]
        quiet = set(said) <= _OF_WIDTH
        off = bool((np.abs((low + high) / 2 - truth) > _WRONG * error).any())
        missed += np.array([1, quiet]) * (share < _MISSED)
        wrong += np.array([1, quiet]) * off
        for cause in said:
            causes[cause] = causes.get(cause, 0) + 1
    seconds = (time.process_time() - start) / len(draws)
    off = float(np.sqrt(np.mean(np.square(means))))
    print(
        f"{name:34} {len(draws):4} {finite:6} {np.mean(shares):8.3f} {off:9.1f} {missed[0]:7} "
        f"{missed[1]:5} {wrong[0]:6} {wrong[1]:5} {seconds:6.2f}  {causes}",
        flush=True,
    )


def _phase_response(made: beats.Beats) -> hj.recordings.PhaseResponse:
    trials = [
        hj.Recording(made.time, {"u": u}, events={"beat": events}, name=f"trial {k}")
        for k, (u, events) in enumerate(zip(made.force, made.events, strict=True))
    ]
    recording = hj.Recording.join(trials)
    return hj.recordings.phase_response(recording, hj.AtEvent("beat"), input="u")


def weak(draws: int) -> None:
    """Print how `fit_series` of a pair goes whose data have another, weak multiplier.

    "off" is the rms error of the pair in standard errors; "quiet" counts misses of more than three
    of them without a finding.
    """
    print("weak multiplier, size    held  rms off  3 off  quiet     n  findings")
    pair = [0.7 * np.exp(0.9j)]
    for size in (0.0, 0.1, 0.3, 1.0):
        fits = []
        counts: dict[str, int] = {}
        for seed in range(draws):
            loop, u, y = truth.weak_series(pair, 0.4, size, seed)
            records = [
                hj.experiments.SectionSeries(a, b, n_sections=3)
                for a, b in zip(u, y, strict=True)
            ]
            try:
                fit = hj.fit_series(records, 2)
            except hj.errors.DefinitionError:
                counts["refused"] = counts.get("refused", 0) + 1
                continue
            true = loop.multipliers[:2]
            error = _nearest(fit.multipliers, true[0]) / fit.standard_errors.max()
            causes = [finding.cause for finding in fit.findings]
            fits.append((bool(fit.contains(true).all()), error, bool(causes)))
            for cause in causes:
                counts[cause] = counts.get(cause, 0) + 1
        held, errors, said = np.array(fits, float).reshape(-1, 3).T
        off = errors > 3
        quiet = int((off & (said == 0)).sum())
        rms = np.sqrt(np.mean(errors**2))
        print(
            f"0.4, {size:3.1f} {int(held.sum()):19} {rms:8.1f} {int(off.sum()):6} {quiet:6} "
            f"{len(fits):5}  {counts}",
            flush=True,
        )


def distortion(draws: int) -> None:
    """Print how often regions of `identify_recording` hold the multiplier of rhythms whose response
    is a little nonlinear, and how often the findings say so.

    "off" is the rms error in standard errors; "silent" counts misses without any finding, "before"
    those without another finding than distortion.
    """
    print(
        "rhythm, noise, push, sections         held  n   off  worst  distortion  silent  before"
    )
    first = next(iter(weakly.RHYTHMS))
    rows = [(name, 0.0, 1.0, 8) for name in weakly.RHYTHMS]
    rows += [(first, 1e-4, 1.0, 8), (first, 1e-4, 0.1, 8)]
    rows += [("pendulum clock", 3e-4, 0.1, 8)]
    rows += [(first, 0.0, 1.0, 16), ("pendulum clock", 0.0, 1.0, 16)]
    for name, noise, size, sections in rows:
        made = weakly.pushed(weakly.RHYTHMS[name], range(draws), noise=noise, size=size)
        found = [_of_pushed(made, k, sections) for k in range(draws)]
        held = np.array([x[0] for x in found])
        off = np.array([x[1] for x in found])
        causes = [x[2] for x in found]
        misses = [x for h, x in zip(held, causes, strict=True) if not h]
        named = sum("distortion" in x for x in causes)
        silent = sum(not x for x in misses)
        before = sum(not x - {"distortion"} for x in misses)
        label = f"{name}, {noise:g}, {size:g}, {sections}"
        print(
            f"{label:37} {held.sum():4} {draws:2} {np.sqrt(np.mean(off**2)):5.1f} "
            f"{off.max():6.1f} {named:11} {silent:7} {before:7}",
            flush=True,
        )


def _of_pushed(
    made: weakly.Pushed, k: int, sections: int
) -> tuple[bool, float, set[str]]:
    """Return whether the region holds the multiplier, the error in standard errors, and causes of
    findings."""
    signals = {"u": made.force[k], "x": made.position[k], "v": made.speed[k]}
    result = hj.identify_recording(
        hj.Recording(made.time, signals),
        hj.Crossing("v", "falling"),
        "u",
        ("x", "v"),
        order=1,
        n_sections=sections,
    )
    fit = result.fit
    error = abs(fit.multipliers[0] - made.multiplier) / fit.standard_errors[0]
    causes = {finding.cause for finding in result.diagnosis.findings} - _OF_BAND
    return bool(np.all(fit.contains([made.multiplier]))), float(error), causes


def natural(draws: int) -> None:
    """Print how often intervals of natural multipliers hold the largest modulus, and in how many of
    the misses nothing is said."""
    print("multipliers, cycles      held     n  share  p of 95 %  quiet  bias")
    for multipliers in truth.NATURAL:
        for cycles in (60, 100, 300):
            held = 0
            quiet = 0
            errors = []
            for seed in range(draws):
                y, true = truth.unperturbed_rhythm(multipliers, cycles, seed)
                found = _natural(y, 1 if np.isreal(multipliers[0]) else 2)
                modulus = float(np.abs(true[0]))
                low, high = found.interval()[0]
                holds = bool(low <= modulus <= high)
                held += holds
                quiet += not holds and not found.findings
                errors.append(abs(found.multipliers[0]) - modulus)
            p = stats.binomtest(held, draws, 0.95).pvalue
            name = f"{np.abs(multipliers[0]):.2f}, {np.angle(multipliers[0]):.1f} rad, {cycles}"
            print(
                f"{name:22} {held:6} {draws:5} {held / draws:6.3f} {p:10.2g} {quiet:6} "
                f"{np.mean(errors):6.3f}",
                flush=True,
            )


def _natural(y: np.ndarray, order: int) -> hj.recordings.NaturalMultipliers:
    """Return the natural multipliers of eight samples a cycle."""
    signals = {f"y{i}": column for i, column in enumerate(y.T)}
    recording = hj.Recording(
        np.arange(len(y)) / 8, signals, events={"e": np.arange(len(y) // 8)}
    )
    data = hj.recordings.sample_sections(
        recording,
        hj.AtEvent("e"),
        inputs=(),
        outputs=recording.signals,
        n_sections=8,
        bandwidth=np.inf,
    )
    return hj.recordings.natural_multipliers(data, order)


def loops(draws: int) -> None:
    """Print errors of `fit_series(references=)` relative to those of `fit_ldtp`, and refusals."""
    print(
        "multipliers, noise      n  refused  names fit_ldtp  ldtp refuses  ratio of rms errors"
    )
    ratios = []
    for noise in (0.0, 1.0):
        for kind, multipliers in enumerate(truth.REFERENCED):
            pairs = []
            refusals = []
            without = 0
            for seed in range(draws):
                loop, r, u, y = truth.referenced_series(kind, seed, noise)
                data = [
                    hj.experiments.SectionSeries(
                        np.concatenate([a, b], axis=1),
                        c,
                        inputs=("u", "r"),
                        n_sections=4,
                    )
                    for a, b, c in zip(u, r, y, strict=True)
                ]
                d = len(loop.multipliers)
                true = loop.multipliers[0]
                try:
                    one = hj.fit_series(data, d, references="r").multipliers
                except hj.errors.DefinitionError as error:
                    refusals.append(str(error))
                    continue
                try:
                    other = hj.fit_ldtp(data, d, references="r").multipliers
                except hj.errors.DefinitionError:
                    without += 1
                    continue
                pairs.append([_nearest(one, true), _nearest(other, true)])
            named = sum("fit_ldtp" in text for text in refusals)
            ratio = np.nan
            if pairs:
                rms = np.sqrt(np.mean(np.square(pairs), axis=0))
                ratio = rms[0] / rms[1]
                ratios.append(ratio)
            print(
                f"{multipliers!s:18} {noise:4.1f} {draws:4} {len(refusals):8} {named:15} "
                f"{without:12} {ratio:9.1f}",
                flush=True,
            )
    low, middle, high = np.quantile(ratios, (0, 0.5, 1))
    print(f"ratios from {low:.1f} to {high:.1f}, median {middle:.1f}")


def _nearest(multipliers: np.ndarray, true: complex) -> float:
    """Return the distance of the nearest multiplier."""
    return float(np.abs(multipliers - true).min())


# Each row with its usual number of draws.
ROWS: dict[str, tuple[Callable[[int], None], int]] = {
    "files": (files, 5),
    "groups": (groups, 400),
    "bands": (bands, 200),
    "series": (series, 60),
    "study": (study, 12),
    "weak": (weak, 60),
    "distortion": (distortion, 40),
    "loops": (loops, 10),
    "phase": (phase, 30),
    "phase-long": (long_phase, 10),
    "natural": (natural, 400),
    "plants": (strangers_plants.plants, 40),
    "pushes": (strangers_plants.pushes, 12),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", help=", ".join(ROWS))
    parser.add_argument("--draws", type=int, default=0)
    parser.add_argument("--short", action="store_true")
    options = parser.parse_args()
    unknown = set(options.rows) - set(ROWS)
    if unknown:
        parser.error(f"no row {', '.join(unknown)}: choose from {', '.join(ROWS)}")
    hj.enable_x64()
    warnings.simplefilter("ignore")
    for name in options.rows or ROWS:
        row, usual = ROWS[name]
        draws = options.draws or usual
        if options.short:
            draws = max(1, draws // 10)
        row(draws)
        sys.stdout.flush()


if __name__ == "__main__":
    main()

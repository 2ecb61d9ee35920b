"""Models written by outsiders: is every answer of `find_limit_cycle` a true cycle, or a refusal?

Each model was written from a textbook or an application note by someone who has not read the code,
and fixed before the first run (`models.py`). Each has at least 10 guesses, also bad ones. Every
answer is examined by scipy with its own events (`check.py`), every refusal by a long simulation
from the same guess: where that settles on a stable cycle, the refusal was not deserved.

    python benchmarks/outsiders                      all models
    python benchmarks/outsiders --only "van der"     models whose names contain this
    python benchmarks/outsiders --group relays       models of one kind
    python benchmarks/outsiders --seed 1             five random guesses more for each model
    python benchmarks/outsiders --part 1/4           every fourth model, beginning with the first
    python benchmarks/outsiders --out results.jsonl  one line of JSON for each guess
"""

import argparse
import collections
import dataclasses
import json
import sys
import time

import numpy as np
from build import answer
from check import settle, verify
from form import Start
from models import GROUPS, MODELS


SLOW = 30.0  # seconds for one guess; slower ones are printed


def random_guesses(model, seed: int, count: int = 5) -> tuple:
    """Guesses near and far from those of the model, in its own charts."""
    generator = np.random.default_rng([seed, *model.name.encode()])
    guesses = []
    for _ in range(count):
        near = model.guesses[int(generator.integers(len(model.guesses)))]
        size = np.abs(model.guesses[0].state).max()
        spread = 10.0 ** generator.uniform(-2, 0.5) * size
        state = np.array(near.state) + spread * generator.standard_normal(
            len(near.state)
        )
        guesses.append(
            Start(near.chart, tuple(map(float, state)), near.time, f"seed {seed}")
        )
    return tuple(guesses)


@dataclasses.dataclass
class Outcome:
    """What became of one guess.

    `verdict` is 'true'; 'other', a true cycle, but not the one found most often; 'constant', a
    solution of a driven system that is at rest; 'refused'; 'undeserved', a refusal although a
    simulation from the guess settles on a stable cycle; 'WRONG'; or 'crash'.
    """

    model: str
    index: int
    guess: str
    verdict: str
    text: str
    period: float | None
    seconds: float
    checked: float
    remarks: list


def describe(guess: Start) -> str:
    return f"{guess.kind}: {guess.chart} {guess.state} at {guess.time}"


def alternating(guesses: list) -> list:
    """First, last, second, last but one: with little time, good and bad ones are tried."""
    ordered, left = [], list(guesses)
    while left:
        ordered.append(left.pop(0))
        if left:
            ordered.append(left.pop())
    return ordered


def likeness(orbit) -> tuple:
    """Equal for the same cycle found twice; its multipliers are then examined once."""
    names = tuple(sorted(event.name for event in orbit.events))
    values = tuple(f"{x:.6g}" for x in orbit.multipliers)
    return names, f"{orbit.period:.9g}", values


def judge(model, index: int, guess: Start, settled: dict) -> Outcome:
    begin = time.monotonic()
    found = answer(model, guess)
    seconds = time.monotonic() - begin
    verdict, text, period, remarks = "", found.text, None, []
    begin = time.monotonic()
    if found.orbit is not None:
        known = likeness(found.orbit)
        report = verify(found.orbit, model, multipliers=known not in settled)
        period, remarks = found.orbit.period, report.remarks
        verdict = "WRONG" if report.complaints else "true"
        if report.complaints == ["an equilibrium"] and model.clock is not None:
            verdict = "constant"
        if verdict == "true":
            settled[known] = True
        shown = np.array2string(np.asarray(found.orbit.multipliers), precision=6)
        text = (
            "; ".join(report.complaints) or f"period {period:.9g}, multipliers {shown}"
        )
    elif found.crash:
        verdict = "crash"
    else:
        key = (guess.chart, guess.state, guess.time)
        if key not in settled:
            settled[key] = settle(
                model, guess.chart, guess.state, guess.time, wall=10.0
            )
        ends = settled[key]
        wanted = model.search.get("multiplicity", 1) if model.clock else 1
        stable = ends.what == "cycle" and ends.turns == wanted
        family = "must be refused" in model.truth
        verdict = "undeserved" if stable and not family else "refused"
        turns = f" in {ends.turns} turns" if ends.turns > 1 else ""
        remarks = [f"scipy: {ends.what} {ends.period:.6g}{turns}", *ends.remarks[:3]]
    return Outcome(
        model.name,
        index,
        describe(guess),
        verdict,
        text,
        period,
        seconds,
        time.monotonic() - begin,
        remarks,
    )


def mark_others(outcomes: list) -> None:
    """True cycles whose period is not the most frequent one are 'other' ones."""
    periods = [f"{o.period:.6g}" for o in outcomes if o.verdict == "true"]
    if not periods:
        return
    usual = collections.Counter(periods).most_common(1)[0][0]
    for outcome in outcomes:
        if outcome.verdict == "true" and f"{outcome.period:.6g}" != usual:
            outcome.verdict = "other"


def show(model, outcomes: list, seconds: float) -> None:
    counts = collections.Counter(o.verdict for o in outcomes)
    words = ", ".join(f"{counts[k]} {k}" for k in VERDICTS if counts[k])
    print(
        f"{model.name}: {len(outcomes)} guesses: {words}; {seconds:.0f} s", flush=True
    )
    causes = collections.Counter(
        " ".join(o.text.split()[:12]) for o in outcomes if o.verdict == "refused"
    )
    for cause, count in causes.most_common():
        print(f"    refused {count}: {cause}")
    for outcome in outcomes:
        if outcome.verdict in ("WRONG", "crash", "undeserved"):
            print(f"    {outcome.verdict} [{outcome.index}] {outcome.guess}")
            print(f"        {outcome.text[:400]}")
            if outcome.remarks:
                print(f"        {'; '.join(map(str, outcome.remarks))[:400]}")
        if outcome.seconds > SLOW:
            print(
                f"    slow [{outcome.index}] {outcome.guess}: {outcome.seconds:.0f} s"
            )
    sys.stdout.flush()


VERDICTS = ("true", "other", "constant", "refused", "undeserved", "WRONG", "crash")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="part of the models' names")
    parser.add_argument("--group", choices=GROUPS, help="models of one kind")
    parser.add_argument(
        "--limit", type=float, default=150.0, help="seconds for one model"
    )
    parser.add_argument("--guess", type=int, help="index of one guess")
    parser.add_argument("--seed", type=int, help="seed of five more guesses each")
    parser.add_argument(
        "--part", default="1/1", help="k/n: every n-th model from the k-th"
    )
    parser.add_argument("--skip", type=int, default=0, help="models to leave out first")
    parser.add_argument("--out", help="file for one line of JSON for each guess")
    parser.add_argument("--list", action="store_true", help="print the models")
    options = parser.parse_args()
    first, step = map(int, options.part.split("/"))
    models = GROUPS[options.group] if options.group else MODELS
    chosen = [m for m in models if options.only in m.name][first - 1 :: step][
        options.skip :
    ]
    if options.list:
        for model in chosen:
            print(
                f"{model.name}: {len(model.guesses)} guesses; {model.source}; {model.truth}"
            )
        return 0
    totals: collections.Counter = collections.Counter()
    for model in chosen:
        guesses = list(enumerate(model.guesses))
        if options.seed is not None:
            extra = random_guesses(model, options.seed)
            guesses += list(enumerate(extra, start=len(guesses)))
        if options.guess is not None:
            guesses = [guesses[options.guess]]
        begin = time.monotonic()
        settled: dict = {}
        outcomes: list = []
        for index, guess in alternating(guesses):
            if time.monotonic() - begin > options.limit:
                print(f"{model.name}: out of time before guess {index}")
                break
            outcome = judge(model, index, guess, settled)
            outcomes.append(outcome)
            if options.out:
                with open(options.out, "a") as file:
                    print(json.dumps(dataclasses.asdict(outcome)), file=file)
        mark_others(outcomes)
        show(model, outcomes, time.monotonic() - begin)
        totals.update(o.verdict for o in outcomes)
    print(f"{len(chosen)} models, {sum(totals.values())} guesses:")
    for verdict in VERDICTS:
        print(f"  {verdict:10} {totals[verdict]}")
    return int(totals["WRONG"] + totals["crash"] > 0)


if __name__ == "__main__":
    sys.exit(main())

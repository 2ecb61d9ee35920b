"""The gallery: every model's limit cycle, multipliers, exact HTF and an estimate laid over it.

For each case of `gallery_cases.py`: the cycle; its multipliers and their error against what is
known of them, relative to the largest; the exact harmonic transfer functions between the sections
stated there, m = -1, 0, 1, from the input to the output; and their estimate from a batch of
experiments (multisines on odd lines up to f = 4, or N/2 if that is less, two windows of 32 periods,
of which the first is discarded), with its largest error relative to the largest |H_0|. An unstable
cycle has no experiments.

    python benchmarks/gallery.py --out DIR [--only NAME ...]

writes a picture for each case, `gallery.json`, and the table `gallery.md` into DIR; cases that an
earlier run left there stay in the table. `--only
branches` follows three of the models along a parameter (`branches.png`).
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from gallery_cases import CASES, Case
from matplotlib import pyplot
from PIL import Image

import hybridjax as hj


HARMONICS = (-1, 0, 1)
PERIODS = 32
NAMES = [*CASES, "branches"]


def compute(
    case: Case,
) -> tuple[hj.orbits.LimitCycle, hj.linear.HTF, hj.linear.HTF | None]:
    """The cycle, the exact HTF, and its estimate."""
    cycle = hj.find_limit_cycle(
        case.system,
        case.guess,
        section=case.section,
        multiplicity=case.multiplicity,
        conserved=case.conserved,
        max_period=case.max_period,
    )
    placed = hj.sections.place_sections(cycle, case.sections)
    model = hj.linearize(cycle, placed, case.output)
    N = placed.n_sections
    design = hj.multisine(
        N,
        PERIODS,
        frequencies=(0, min(4.0, N / 2)),
        amplitude=case.amplitude or 1.0,
        lines="odd",
        inputs=case.system.inputs,
    )
    estimate = None
    if case.amplitude:
        data = hj.run_experiments(
            cycle,
            placed,
            design,
            case.output,
            start=case.start,
            discard=PERIODS,
            accuracy=1e-11,
        )
        assert data.ok.all(), data.summary()
        estimate = hj.estimate_htf(
            data, harmonics=[h for h in HARMONICS if -N / 2 <= h < N / 2]
        )
    f = np.unique(design.frequency) if estimate is None else estimate.frequencies
    harmonics = HARMONICS if estimate is None else estimate.harmonics
    return cycle, model.htf(f, harmonics=harmonics), estimate


def numbers(
    case: Case,
    cycle: hj.orbits.LimitCycle,
    exact: hj.linear.HTF,
    estimate: hj.linear.HTF | None,
) -> dict:
    """What the table says."""
    multipliers = cycle.multipliers
    truth = np.asarray(case.truth, complex)
    size = np.max(np.abs(truth), initial=0.0) or 1.0
    return {
        "title": case.title,
        "period": float(cycle.period),
        "events": [e.name for e in cycle.trajectory().events],
        "sections": exact.n_sections,
        "multipliers": [[z.real, z.imag] for z in multipliers],
        "multiplier error": float(
            np.max(np.abs(multipliers - truth), initial=0.0) / size
        ),
        "source": case.source,
        "channel": f"{case.push} to {case.output}",
        "largest H_0": float(np.max(np.abs(exact[0]))),
        "HTF error": None if estimate is None else float(estimate.error(exact)[0]),
    }


def draw(
    case: Case,
    cycle: hj.orbits.LimitCycle,
    exact: hj.linear.HTF,
    estimate: hj.linear.HTF | None,
    path: Path,
):
    """The cycle (of one that is rest: its multipliers), and |H_m| beside it; of a walker, a turn
    before."""
    with hj.plot.style():
        widths = (1.2,) * bool(case.sticks) + (1, 1.5)
        figure, (*before, left, right) = pyplot.subplots(
            1,
            len(widths),
            figsize=(hj.plot.PAGE, 2.7),
            layout="constrained",
            width_ratios=widths,
        )
        for ax in before:
            sticks(case, cycle, ax)
        if case.plane is None:
            hj.plot.multipliers(cycle, ax=left, zoom=False)
        else:
            hj.plot.cycle(cycle, *case.plane, ax=left)
        htfs = [exact] if estimate is None else [estimate, exact]
        hj.plot.htf(*htfs, harmonics=(0, 1, -1)[: len(exact.harmonics)], ax=right)
        lowest = min(
            np.min(line.get_ydata(), initial=np.inf) for line in right.get_lines()
        )
        right.set_ylim(bottom=max(lowest / 2, right.get_ylim()[0]))
        legend = right.get_legend()
        right.legend(
            legend.legend_handles,
            [x.get_text() for x in legend.get_texts()],
            loc="lower center",
            bbox_to_anchor=(0.5, 1.0),
            ncols=4,
        )
        figure.suptitle(f"{case.title}: {case.push} to {case.output}", fontsize=8)
        save(path, figure)


def sticks(case: Case, cycle: hj.orbits.LimitCycle, ax) -> None:
    """One turn of a walker at equal times, lighter where it is earlier, up to the touchdown (not to
    the exchange of its legs)."""
    links = len(case.sticks[0][0])
    names = cycle.system.charts()["step"].states[:links]
    t, *angles = cycle.trajectory()(*names)
    for part in np.linspace(0, 1, 7):
        now = np.stack(angles)[:, np.searchsorted(t, part * (1 - 1e-9) * t[-1])]
        way = np.stack([np.sin(now), np.cos(now)])
        for line, color in zip(case.sticks, ("C0", "C1", "0.3"), strict=True):
            x, y = way @ np.array(line, float).T
            ax.plot(x, y, color=color, alpha=0.25 + 0.75 * part, lw=1)
    ax.axhline(0, color="0.7", lw=0.5, zorder=0)
    ax.set(aspect="equal", xlabel="m", ylabel="m")


def branches(path: Path) -> None:
    """Duffing's resonance, the buck converter's period doubling, and the two gaits."""
    m, strike = hj.models, hj.AtEvent("heelstrike")
    walker, buck = m.SimplestWalker(), m.BuckConverter()
    doubled = hj.find_limit_cycle(
        m.BuckConverter(Vin=25.0), hj.Guess("open", (12.04, 0.627, 3.8)), multiplicity=2
    )
    gaits = [
        hj.find_limit_cycle(walker, guess, section=strike)
        for guess in (walker.guess(), walker.short_gait())
    ]
    panels = [
        ("x", [hj.continuation(hj.find_limit_cycle(m.Duffing()), "rate", (0.5, 2.0))]),
        (
            "v",
            [
                hj.continuation(hj.find_limit_cycle(buck), "Vin", (20.0, 26.0)),
                hj.continuation(doubled, "Vin", (24.0, 25.5)),
            ],
        ),
        ("th", [hj.continuation(gait, "slope", (0.002, 0.018)) for gait in gaits]),
    ]
    with hj.plot.style():
        figure, axes = pyplot.subplots(
            1, 3, figsize=(1.4 * hj.plot.PAGE, 3.0), layout="constrained"
        )
        for ax, (output, some) in zip(axes, panels, strict=True):
            hj.plot.branch(*some, output=output, ax=ax)
            print(*some, sep="\n")
        save(path, figure)


def save(path: Path, figure) -> None:
    """As a small file: a palette is enough."""
    figure.savefig(path, dpi=90)
    pyplot.close(figure)
    with Image.open(path) as image:
        image.convert("RGB").quantize(128).save(path, optimize=True)


def table(rows: dict[str, dict]) -> str:
    """The table of the page docs/gallery.md."""
    lines = [
        "| model | period | N | multipliers | error | truth | channel | error of H |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows.values():
        values = [complex(*z) for z in row["multipliers"]]
        shown = ", ".join(_text(z) for z in values if z.imag >= 0) or "0"
        error = "-" if row["HTF error"] is None else f"{row['HTF error']:.0e}"
        lines.append(
            f"| {row['title']} | {row['period']:.8g} | {row['sections']} | {shown} "
            f"| {row['multiplier error']:.0e} | {row['source']} | {row['channel']} | {error} |"
        )
    return "\n".join(lines) + "\n"


def _text(z: complex) -> str:
    return f"{z.real:.8g} ± {z.imag:.8g}j" if z.imag else f"{z.real:.8g}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES)
    options = parser.parse_args()
    hj.enable_x64()
    options.out.mkdir(parents=True, exist_ok=True)
    numbers_file = options.out / "gallery.json"
    rows = json.loads(numbers_file.read_text()) if numbers_file.exists() else {}
    if "branches" in options.only:
        branches(options.out / "branches.png")
    for name in (x for x in options.only if x != "branches"):
        begin = time.process_time()
        case = CASES[name]()
        found = compute(case)
        rows[name] = numbers(case, *found)
        picture = "".join(c if c.isalnum() else "-" for c in name.lower()).replace(
            "--", "-"
        )
        draw(case, *found, options.out / f"{picture}.png")
        print(
            table({name: rows[name]}).splitlines()[-1],
            f"({time.process_time() - begin:.0f} s)",
        )
        rows = {x: rows[x] for x in CASES if x in rows}
        numbers_file.write_text(json.dumps(rows, indent=1))
        (options.out / "gallery.md").write_text(table(rows))


if __name__ == "__main__":
    main()

"""What was found in a recording, as one page that needs no other file."""

import html
import re
from collections.abc import Iterable, Sequence

import numpy as np

from .. import __version__
from .._core.text import p_value
from ..recordings.identification import Identification
from ..recordings.recording import Recording


# Sampling rates of trials that differ by less, as a share, are one.
_SAME_RATE = 0.01
_CAPTIONS = {
    "bode": "Magnitude and phase of H₀, with bands of 95 %.",
    "harmonics": "Magnitudes of H₀, H₁ and H₋₁, with bands of 95 %.",
}
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 1rem auto; padding: 0 1rem;
  color: #222; } h1, h2 { line-height: 1.2; } h1 { font-size: 1.6rem; margin: 0 0 .5rem; }
h2 { font-size: 1.25rem; margin: 2rem 0 .5rem; } p { margin: .5rem 0; }
.table { overflow-x: auto; } table { border-collapse: collapse; margin: .5rem 0; }
th, td { padding: .2rem .8rem; border-bottom: 1px solid #ddd; text-align: right; }
td { white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
.main { font-size: 1.1rem; } .main strong { display: block; } .main span { font-size: 1rem; }
dl { display: grid; grid-template-columns: repeat(auto-fit, minmax(11rem, 1fr)); gap: .5rem 1rem;
  margin: .75rem 0; } dl div { border-top: 2px solid #0072B2; padding-top: .2rem; }
dt { color: #555; font-size: .85rem; } dd { margin: 0; }
.warn { border-left: 4px solid #D55E00; padding: .3rem 1rem; background: #fdf3ec; }
.fine { border-left: 4px solid #009E73; padding: .3rem 1rem; background: #edf8f4; }
img { max-width: 100%; height: auto; } figure { margin: 1rem 0; }
.wide { overflow-x: auto; } .wide img { min-width: 44rem; }
figcaption { color: #555; font-size: .9rem; } ul { margin: .5rem 0; padding-left: 1.2rem; }
"""


def page(found: Identification, images: dict[str, str]) -> str:
    """HTML, with the figures given as PNG in base 64."""
    parts = [
        *_summary(found),
        _figure(images["multipliers"], "Multipliers with 95 % regions in the unit circle."),
        *_reliability(found),
        *_validation(found, images),
        "<h2>Responses to a push</h2>",
        f"<p>What a brief push of area 1 (standard deviation {found.responses.width:.2g} cycles) "
        "does at each phase of the cycle.</p>",
        _figure(images["impulse_responses"], "Bands hold the true response with 95 %.", wide=True),
        "<h2>Harmonic transfer functions</h2>",
        *(
            _figure(image, _CAPTIONS[name.split("_")[0]])
            for name, image in images.items()
            if name.startswith(("bode", "harmonics"))
        ),
        *_recording(found, images),
    ]
    title = _safe(f"Multipliers of {', '.join(t.name for t in found.recording.trials)}")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head>\n<body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def sampling_rates(recording: Recording) -> list[float]:
    """Of each trial, in Hz: one over the median time between samples."""
    return [float(1 / np.median(np.diff(t.time))) for t in recording.trials]


def left_out(found: Identification) -> list[str]:
    """What of a recording was not used, and why, in sentences."""
    phase, held = found.phase, found.held_out.validation
    parts = []
    if phase.dropped:
        parts.append(
            f"{phase.dropped} doubled events: less than half a period after the one before."
        )
    if phase.missed:
        parts.append(
            f"{phase.missed} cycles whose beginning or end is not known: an event was missed, a "
            "crossing lies in a gap, or the instruments paused."
        )
    if found.data.missing:
        parts.append(
            f"{_percent(found.data.missing)} of the samples at sections: they lie in gaps longer "
            "than the time between two sections."
        )
    if phase.backwards:
        parts.append(
            f"The phase ran backwards, in noise, at {_percent(phase.backwards)} of the samples: it "
            "was replaced by the mean of two monotone envelopes."
        )
    if held.left_out:
        parts.append(
            f"{held.left_out} stretches from the validation: too short to say more than how they "
            "began. They count in the fit."
        )
    return parts


def _summary(found: Identification) -> list[str]:
    """What a reader needs, on one screen: multipliers, how much there was, warnings."""
    data, phase, held = found.data, found.phase, found.held_out.validation
    trials = found.recording.trials
    duration = sum(float(t.time[-1] - t.time[0]) for t in trials)
    low, high = min(rates := sampling_rates(found.recording)), max(rates)
    rate = f"{low:.4g} Hz" if high < (1 + _SAME_RATE) * low else f"{low:.4g} to {high:.4g} Hz"
    explained = zip(held.outputs, held.fit, strict=True)
    facts = {
        "strides": f"{data.cycles:.0f} of about {duration / phase.period:.0f}, in "
        f"{_count(len(trials), 'trial')}, {_count(len(data.records), 'stretch', 'stretches')}",
        "period": f"{phase.period:.4g} s, ± {_percent(phase.jitter)} from cycle to cycle",
        "sampled at": f"{rate}, for {duration:.4g} s",
        "explained of strides held out": ", ".join(f"{n} {x:.1f}\u00a0%" for n, x in explained),
    }
    listed = "".join(f"<div><dt>{k}</dt><dd>{_safe(v)}</dd></div>" for k, v in facts.items())
    names = [
        ", ".join(f"{n} ({u})" if u else n for n, u in pairs)
        for pairs in (
            _with_units(found)[: len(data.inputs)],
            _with_units(found)[len(data.inputs) :],
        )
    ]
    left = "".join(f"<li>{_sentence(x)}</li>" for x in left_out(found) + _assumed(found.recording))
    return [
        "<h1>Floquet multipliers from a recording</h1>",
        f"<p>{_safe(', '.join(t.name for t in trials))}: from {_safe(names[0])} to "
        f"{_safe(names[1])}, {data.n_sections} sections per cycle.</p>",
        *_multipliers(found),
        f"<dl>{listed}</dl>",
        *(f'<p class="warn">{_sentence(repr(w))}</p>' for w in found.advice.warnings),
        *([] if found.advice.warnings else ['<p class="fine">Nothing speaks against the fit.</p>']),
        f"<p>Left out, and assumed:</p><ul>{left}</ul>" if left else "<p>Nothing was left out.</p>",
        "<p>A multiplier says what is left of a deviation from the average cycle one cycle later. "
        "A modulus below 1 is stable; the smaller, the faster the return.</p>",
    ]


def _multipliers(found: Identification) -> list[str]:
    """Each with its 95 % region, as wide and as high as that is, and its modulus."""
    lines = []
    for i, z in _upper(found):
        border = found.fit.ellipse(i)
        pair = " and its conjugate" if z.imag else ""
        reach = f"±\u00a0{np.ptp(border.real) / 2:.2g}"
        if z.imag:
            reach = f"real part {reach}, imaginary part ±\u00a0{np.ptp(border.imag) / 2:.2g}"
        size = np.abs(border)
        lines.append(
            f'<p class="main"><strong>{_complex(z)}{pair}</strong> <span>95 % region: {reach}; '
            f"modulus {abs(z):.4f}, from {size.min():.4f} to {size.max():.4f}</span></p>"
        )
    return lines


def _reliability(found: Identification) -> list[str]:
    """What is behind the intervals, and what more strides would bring."""
    fit, advice = found.fit, found.advice
    pairs = _upper(found)
    return [
        "<h2>How sure they are</h2>",
        _table(
            ("multiplier", "standard error", "plain regression (ARX), for comparison"),
            [
                (_complex(z), f"{fit.standard_errors[i]:.1e}", _complex(advice.plain[i]))
                for i, z in pairs
            ],
        ),
        "<p>Standard errors to be expected from other numbers of strides like these:</p>",
        _table(
            ("strides", *(_complex(z) for _, z in pairs)),
            [
                (str(n), *(f"{e[i]:.1e}" if np.isfinite(e[i]) else "too few" for i, _ in pairs))
                for n, e in zip(advice.strides, advice.expected, strict=True)
            ],
        ),
    ]


def _validation(found: Identification, images: dict[str, str]) -> list[str]:
    held = found.held_out.validation
    units = dict(_with_units(found))
    rows = [
        (
            name,
            f"{held.fit[i]:.1f} %",
            f"{held.noise[i]:.2e} {units[name]}".rstrip(),
            p_value(float(held.whiteness[i])),
            p_value(float(held.independence[i])),
        )
        for i, name in enumerate(held.outputs)
    ]
    return [
        "<h2>Validation on strides that were held out</h2>",
        "<p>A model of most strides (the first three quarters of each stretch, or whole ones where "
        "they are short), simulated on the others. The tests look for what it leaves unexplained; "
        "small p-values say that there is something (process noise, nonlinearity, smoothing), not "
        "that the multipliers are wrong.</p>",
        _table(
            ("output", "explained", "rms left", "left is white", "independent of the input"), rows
        ),
        _figure(
            images["validation"],
            "Measured and simulated deviations; correlations of what is left.",
            wide=True,
        ),
    ]


def _recording(found: Identification, images: dict[str, str]) -> list[str]:
    data, phase, fit = found.data, found.phase, found.fit
    rows = [
        (name, f"{x:.3g} {unit}".rstrip())
        for (name, unit), x in zip(_with_units(found), np.concatenate(data.rms()), strict=True)
    ]
    return [
        "<h2>The recording</h2>",
        _table(("signal", "rms deviation from the average cycle"), rows),
        f"<p>{phase.cycles} whole cycles. Period {phase.period:.4g} s (median), with a standard "
        f"deviation of {_percent(phase.jitter)} from cycle to cycle and a drift of "
        f"{100 * phase.drift:.2g} % per cycle.</p>",
        _figure(images["phase"], "Durations of the cycles.", wide=True),
        _figure(
            images["sections"],
            "Average cycle; deviations with twice their standard deviation; power of inputs, and "
            "outputs from cycle to cycle at the section where they vary most.",
            wide=True,
        ),
        f"<p>hybridjax {__version__}. Deviations are smoothed with a bandwidth of "
        f"{data.bandwidth:.3g} Hz; output-error fit with {fit.numerators.shape[1]} lags; regions "
        "from the residuals, "
        "cycle by cycle.</p>",
    ]


def _upper(found: Identification) -> list[tuple[int, complex]]:
    """Index and value of the multipliers, of pairs the first."""
    return [(i, complex(z)) for i, z in enumerate(found.fit.multipliers) if z.imag >= 0]


def _with_units(found: Identification) -> list[tuple[str, str]]:
    data = found.data
    return list(zip(data.inputs + data.outputs, data.units, strict=True))


def _assumed(recording: Recording) -> list[str]:
    return [f"{note[0].upper()}{note[1:]}." for note in recording.notes]


def _safe(text: str) -> str:
    return html.escape(text)


def _sentence(text: str) -> str:
    """With names of arguments, which stand between backticks, as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", _safe(text))


def _percent(share: float) -> str:
    return f"{100 * share:.2g}\u00a0%"


def _count(number: int, one: str, many: str | None = None) -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def _complex(z: complex) -> str:
    shown = f"{z.real:.4f}" + (
        f" {z.imag:+.4f}i".replace("+", "+ ").replace("-", "- ") if z.imag else ""
    )
    return shown.replace("-", "−")


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells, tag):
        return "<tr>" + "".join(f"<{tag}>{_safe(c)}</{tag}>" for c in cells) + "</tr>"

    body = line(header, "th") + "".join(line(r, "td") for r in rows)
    return f'<div class="table"><table>{body}</table></div>'


def _figure(image: str, caption: str, wide: bool = False) -> str:
    """`wide`: of several panels side by side, which narrow screens scroll rather than shrink."""
    name = "wide" if wide else "narrow"
    return (
        f'<figure><div class="{name}"><img alt="{_safe(caption)}" '
        f'src="data:image/png;base64,{image}"></div>'
        f"<figcaption>{_safe(caption)}</figcaption></figure>"
    )

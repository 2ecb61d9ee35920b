import dataclasses
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.identify.multiplier_estimate import MultiplierEstimate

from ..toys import Field


def labeled(ax):
    """Lines by label, without the helpers that matplotlib or the axes hide."""
    return {
        line.get_label(): line for line in ax.get_lines() if line.get_label()[0] != "_"
    }


def test_magnitude_draws_the_values(estimate, exact):
    ax = hj.plot.htf(estimate, exact, output="vM").ax
    lines = labeled(ax)
    assert list(lines) == ["$H_{0}$", "$H_{1}$", "$H_{-1}$", "exact"]
    drawn = lines["$H_{1}$"]
    assert_array_equal(drawn.get_xdata(), estimate.frequencies)
    first_harmonic = estimate[1][:, 1, 0]
    modulus = np.abs(first_harmonic)
    assert_array_equal(drawn.get_ydata(), modulus)
    assert (
        drawn.get_color()
        == lines["$H_{-1}$"].get_color()
        != lines["$H_{0}$"].get_color()
    )
    assert drawn.get_linestyle() == "-"
    assert lines["$H_{-1}$"].get_linestyle() == "--"
    assert ax.get_yscale() == "log"
    assert "cycles/period" in ax.get_xlabel()
    assert ax.get_ylabel() == "$|H_m|$, vM"


def test_a_model_is_drawn_beside_an_estimate(hopper, estimate, exact):
    def harmonics(*given):
        return hj.plot.htf({"a": given})

    for draw in (hj.plot.htf, hj.plot.bode, harmonics):
        from_model = draw(estimate, hopper).ax.lines
        from_htf = draw(estimate, exact).ax.lines
        for line, expected in zip(from_model, from_htf, strict=True):
            assert_allclose(line.get_xydata(), expected.get_xydata(), rtol=1e-9)
    # Alone, up to half of its sections in a period.
    drawn, *_ = hj.plot.bode(hopper).ax.lines
    f, size = drawn.get_xydata().T
    assert f[0] == 0
    assert f[-1] == 16
    response = hopper.htf(f, harmonics=0).H
    H = response[0, :, 0, 0]
    assert_allclose(size, abs(H), rtol=1e-9)
    hj.plot.bode(hopper.htf([0.3]))  # a single frequency


def test_harmonics_is_a_grid_of_outputs_and_families(estimate, exact):
    families = {"isochron": (estimate, exact), "again": exact}
    figure = hj.plot.htf(families).figure
    assert isinstance(figure, Figure)
    upper_left, upper_right, lower_left, lower_right = figure.axes
    assert upper_left.get_title() == "isochron"
    assert upper_right.get_title() == "again"
    assert upper_left.get_ylabel() == "$|H_m|$, yM"
    assert lower_left.get_ylabel() == "$|H_m|$, vM"
    letters = [ax.get_title(loc="left") for ax in figure.axes]
    assert letters == ["A", "B", "C", "D"]
    legends = [ax for ax in figure.axes if ax.get_legend() is not None]
    assert len(legends) == 1
    assert upper_left.get_ylim() == upper_right.get_ylim()


def test_bode_with_fits(estimate, exact, rational, structured):
    figure = hj.plot.bode(estimate, exact, fits=[rational, structured]).figure
    upper, lower = figure.axes
    assert list(labeled(upper)) == [
        "yM",
        "vM",
        "rational fit",
        "structured fit",
        "exact",
    ]
    assert upper.get_ylabel() == "$|H_{0}|$"
    assert "degrees" in lower.get_ylabel()
    curves = [x for x in upper.get_lines() if len(x.get_xdata())]
    lower_curves = lower.get_lines()
    assert len(curves) == len(lower_curves) == 2 * 4
    response = rational.htf(estimate.frequencies)
    fitted = response.H[0, :, 0, 0]
    assert_allclose(curves[2].get_ydata(), np.abs(fitted))
    phases = [x.get_ydata() for x in lower.get_lines()]
    assert_allclose(phases[0], phases[3], atol=2)  # no curve is a whole turn away
    assert_allclose(phases[1], phases[0], atol=2)


def test_curves_of_one_input_and_output_lie_together_in_any_order_of_names():
    """Indices are those of the first HTF, and a fit is drawn over its own input."""
    f = np.linspace(0.05, 1.4, 12)
    exact = hj.testing.synthetic_ldtp().htf(f, 0)
    swapped = hj.linear.HTF(
        exact.frequencies,
        exact.H[..., ::-1, ::-1],
        0,
        exact.n_sections,
        exact.inputs[::-1],
        exact.outputs[::-1],
        "exact",
    )
    renamed = hj.linear.HTF(
        exact.frequencies,
        exact.H,
        0,
        exact.n_sections,
        ("r", "s"),
        exact.outputs,
        "exact",
    )
    for draw, shown in ((hj.plot.htf, {"harmonics": [0]}), (hj.plot.bode, {})):
        first, second, *_ = draw(exact, swapped, input=1, **shown).ax.lines
        draw(exact, renamed, input=1, **shown)
        H_0 = exact[0][:, 0, 1]
        modulus = np.abs(H_0)
        assert_allclose(first.get_ydata(), modulus)
        assert_array_equal(first.get_ydata(), second.get_ydata())
    fit = hj.identify.fit_rational(exact, input=1)
    with pytest.raises(
        hj.errors.DefinitionError, match=f"there is no input '{exact.inputs[0]}'"
    ):
        hj.plot.bode(exact, fits=fit, input=0)


def test_bode_in_hertz_and_decibels(estimate):
    """As python-control draws it, with a gain of 20 log10 and the frequencies in units of time."""

    def drawn(**options):
        axes = hj.plot.bode(estimate, outputs="vM", **options).axes
        upper, lower = axes[:, 0]
        return upper, lower, labeled(upper)["vM"]

    upper, lower, gain = drawn(unit="Hz", period=0.5, log=True)
    f = np.asarray(estimate.frequencies)
    assert_allclose(gain.get_xdata(), f / 0.5)
    modulus = np.abs(estimate[0][:, 1, 0])
    decibels = 20 * np.log10(modulus)
    assert_allclose(gain.get_ydata(), decibels)
    hertz = lower.get_lines()[0].get_xdata()
    assert_allclose(hertz, f / 0.5)
    assert (upper.get_xscale(), lower.get_xscale()) == ("log", "log")
    assert upper.get_yscale() == "linear"
    assert "(Hz)" in lower.get_xlabel()
    assert "dB" in upper.get_ylabel()
    upper, lower, gain = drawn(unit="rad/s", period=0.5)
    assert_allclose(gain.get_xdata(), 4 * np.pi * f)
    modulus = np.abs(estimate[0][:, 1, 0])
    assert_allclose(gain.get_ydata(), modulus)
    assert (upper.get_xscale(), upper.get_yscale()) == ("linear", "log")
    with pytest.raises(hj.errors.DefinitionError, match="needs the `period`"):
        drawn(unit="Hz")


def test_the_period_of_a_cycle_is_in_its_own_unit(estimate):
    def cycle(unit):
        driven = hj.HybridSystem.from_functions(
            ("x",),
            lambda t, q, u, p: (-q[0] + jnp.cos(jnp.pi * t / 10),),
            period=20.0,
            time_unit=unit,
        )
        return hj.find_limit_cycle(driven, hj.Guess("main", (0.0,)))

    drawn = hj.plot.bode(estimate, unit="Hz", period=cycle("ms"))
    line = drawn.axes[0, 0].get_lines()[0]
    frequencies = np.asarray(estimate.frequencies)
    assert_allclose(line.get_xdata(), frequencies * 50)
    with pytest.raises(hj.errors.DefinitionError, match="'strides', is none of s,"):
        hj.plot.bode(estimate, unit="Hz", period=cycle("strides"))


@pytest.mark.slow
def test_a_branch_lists_the_lines_that_it_draws():
    cycle = hj.find_limit_cycle(hj.models.HopfOscillator())
    branch = hj.continuation(cycle, "mu", (0.1, 0.12), step=0.5)
    legend = branch.plot().ax.get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["stable"]


@pytest.mark.slow
def test_branches_of_several_systems_have_one_output():
    """The default is that of the first, though another system begins with another state."""

    class Renamed(hj.models.HopfOscillator):
        names = ("v", "x")

        def charts(self):
            return {"plane": Field(self.names, self._plane)}

    class Unlike(Renamed):
        names = ("p", "q")

    def along_mu(system):
        cycle = hj.find_limit_cycle(system)
        return hj.continuation(cycle, "mu", (0.1, 0.12), step=0.5)

    branches = along_mu(hj.models.HopfOscillator()), along_mu(Renamed())
    ax = hj.plot.branch(*branches).ax
    assert ax.get_ylabel() == "largest x"
    drawn = [line for line in ax.get_lines() if len(line.get_xdata())]
    for line, branch in zip(drawn, branches, strict=True):
        assert_array_equal(line.get_ydata(), branch.largest("x"))
    with pytest.raises(hj.errors.DefinitionError, match="no output 'x'"):
        hj.plot.branch(branches[0], along_mu(Unlike()))


def bodes(*given, **options):
    return hj.plot.bode({"a": given}, **options)


def harmonics(*given, **options):
    return hj.plot.htf({"a": given}, **options)


@pytest.fixture
def two_inputs():
    """An exact HTF from two inputs to two outputs."""
    f = np.linspace(0.05, 1.4, 12)
    exact = hj.testing.synthetic_ldtp().htf(f, 0)
    assert len(exact.inputs) == 2
    assert len(exact.outputs) == 2
    return exact


@pytest.mark.parametrize("draw", [hj.plot.bode, bodes])
def test_every_input_is_drawn_and_named(draw, two_inputs):
    upper = draw(two_inputs).figure.axes[0]
    curves = [line for line in upper.get_lines() if len(line.get_xdata())]
    pairs = [(0, 0), (0, 1), (1, 0), (1, 1)]
    names = []
    for curve, (i, j) in zip(curves, pairs, strict=True):
        H_0 = two_inputs[0][:, i, j]
        modulus = np.abs(H_0)
        assert_allclose(curve.get_ydata(), modulus)
        output = two_inputs.outputs[i]
        source = two_inputs.inputs[j]
        names.append(f"{output} from {source}")
    assert list(labeled(upper)) == [*names, "exact"]
    colors = {curve.get_color() for curve in curves}
    assert len(colors) == 4, "a color for each pair"


def test_bodes(estimate, exact, rational):
    families = {"a": (estimate, exact), "b": estimate}
    figure = hj.plot.bode(families, fits={"b": rational}).figure
    lower_axes = np.reshape(figure.axes, (2, 2))[1]
    measured = [len(ax.get_lines()) for ax in lower_axes]
    assert measured == [4, 4]
    with pytest.raises(hj.errors.DefinitionError, match="`fits`: there is no name 'c'"):
        hj.plot.bode(families, fits={"c": rational})


@pytest.mark.slow
def test_fits_are_drawn_beside_htfs_and_alone(hopper, estimate, structured):
    """Also those of results, in lists and by name."""
    beside = hj.plot.bode(estimate, structured).axes[0, 0]
    same = hj.plot.bode(estimate, fits=structured).axes[0, 0]
    for line, expected in zip(beside.get_lines(), same.get_lines(), strict=True):
        assert_array_equal(line.get_xydata(), expected.get_xydata())
        assert line.get_color() == expected.get_color()
    assert list(labeled(beside)) == ["yM", "vM", "structured fit"]

    design = hj.multisine(periods=16, frequencies=(0, 4.0)).realizations(2)
    data = hj.experiments.simulate_experiments(hopper, design, start="periodic")
    noisy = hj.experiments.add_noise(data, snr=60)
    series = hj.fit_series(noisy, order=2, check=False)
    upper = hj.plot.bode(series).axes[0, 0]
    line = labeled(upper)["yM"]
    f, size = line.get_xydata().T
    half = hopper.n_sections / 2
    assert f[0] == 0
    assert f[-1] == half
    response = series.htf(f, 0)
    assert_allclose(size, abs(response.H[0, :, 0, 0]), rtol=1e-9)
    assert upper.collections, "a band"
    magnitudes = hj.plot.htf(series).ax
    line = magnitudes.get_lines()[0]
    assert_allclose(line.get_xydata().T, [f, size], rtol=1e-9)

    families = {"model": hopper, "fit": series, "both": [estimate, series]}
    upper = hj.plot.bode(families).axes[0]
    titles = [panel.get_title() for panel in upper]
    assert titles == ["model", "fit", "both"]
    both = upper[2]
    drawn = [x for x in both.get_lines() if len(x.get_xdata())]
    black = [x for x in drawn if x.get_color() == "black"]
    assert len(black) == 2
    for draw in (hj.plot.bode, hj.plot.htf):
        with pytest.raises(hj.errors.DefinitionError, match="band of its data"):
            draw(structured)
        with pytest.raises(hj.errors.DefinitionError, match="band of its data"):
            draw({"a": structured})
        with pytest.raises(hj.errors.DefinitionError, match="band of its data"):
            draw(hopper, structured)


# The complex plane


def test_a_fit_lies_over_the_curves_of_its_own_input(two_inputs):
    fit = hj.identify.fit_rational(two_inputs, input=1)
    upper = hj.plot.bode(two_inputs, fits=fit).figure.axes[0]
    lines = [line for line in upper.get_lines() if len(line.get_xdata())]
    fitted = [line for line in lines if line.get_color() == "black"]
    assert len(fitted) == len(two_inputs.outputs)


@pytest.mark.parametrize("draw", [hj.plot.htf, harmonics])
def test_the_name_of_a_single_input_is_on_the_axis(draw, two_inputs):
    output = two_inputs.outputs[0]
    first, second = two_inputs.inputs
    drawn = draw(two_inputs, harmonics=[0])
    label = drawn.figure.axes[0].get_ylabel()
    assert label.startswith(f"$|H_m|$, {output} from {first}")
    label = draw(two_inputs, harmonics=[0], input=1).figure.axes[0].get_ylabel()
    assert label.startswith(f"$|H_m|$, {output} from {second}")


def test_multipliers(hopper, rational, structured):
    fits = {"2p1z": rational, "structured": structured}
    ax = hj.plot.multipliers(hopper, fits).ax
    lines = labeled(ax)
    names = [label.split(":")[0] for label in lines]
    assert names == ["exact", "2p1z, yM", "2p1z, vM", "structured"]
    exact = hopper.multipliers
    points = np.stack([exact.real, exact.imag], 1)
    assert_array_equal(lines["exact"].get_xydata(), points)
    styles = {(line.get_marker(), line.get_color()) for line in lines.values()}
    assert len(styles) == 4
    error = f"{structured.compare(exact).max_error:.1e}"
    mantissa = error.split("e")[0]
    assert mantissa in list(lines)[-1]

    (inset,) = ax.child_axes
    (left, right) = inset.get_xlim()
    (low, high) = inset.get_ylim()
    for values in (exact, *rational.multipliers, structured.multipliers):
        upper = values[values.imag > 0][0]
        assert left < upper.real < right
        assert low < upper.imag < high


def test_poles_and_zeros(rational):
    moved = eqx.tree_at(
        lambda fit: fit.zeros, rational, np.array([[np.nan + 0j], [0.9 + 0j]])
    )
    figure = hj.plot.poles_zeros({"isochron": rational, "kinematic": moved}).figure
    assert len(figure.axes) == 4
    for i, ax in enumerate(figure.axes[:2]):
        poles = labeled(ax)["poles, isochron"].get_xydata()
        imaginary = rational.poles[i].imag
        assert_array_equal(poles[:, 1], imaginary)
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 4
    with pytest.raises(hj.errors.DefinitionError, match="one or more fits"):
        hj.plot.poles_zeros({})


def test_experiment(hopper):
    design = hj.multisine(periods=4, frequencies=(0, 2.0))
    data = hj.experiments.simulate_experiments(hopper, design, discard=2)
    figure = data.plot(-1).figure
    assert [ax.get_ylabel() for ax in figure.axes] == [
        "u",
        r"$\delta$ yM",
        r"$\delta$ vM",
    ]
    y = figure.axes[2].get_lines()[0]
    last = data.y[-1, :, 1]
    assert_array_equal(y.get_ydata(), last)
    assert_allclose(y.get_xdata()[32], 1.0)
    assert "cycles" in figure.axes[2].get_xlabel()
    with pytest.raises(hj.errors.DefinitionError, match="no experiment 99"):
        data.plot(99)


def test_saved_in_several_formats(tmp_path):
    plot = hj.plot.multipliers([0.5])
    formats = ("png", "pdf", "svg")
    png, pdf, svg = plot.save(tmp_path / "multipliers.png", formats)
    assert png.read_bytes()[:4] == b"\x89PNG"
    assert pdf.read_bytes()[:5] == b"%PDF-"
    assert "<svg" in svg.read_text()
    expected = [f"multipliers.{x}" for x in ("png", "pdf", "svg")]
    assert [p.name for p in (png, pdf, svg)] == expected
    files = plot.save(str(tmp_path / "v1.0"))
    assert files == (tmp_path / "v1.0.png",)
    assert len(list(tmp_path.iterdir())) == 4
    assert isinstance(plot.figure.get_layout_engine(), ConstrainedLayoutEngine)
    with pytest.raises(hj.errors.DefinitionError, match="x.bmp': formats are png"):
        plot.save(tmp_path / "x.bmp")


def test_a_crowd_of_multipliers_has_no_inset():
    ticks = np.arange(-4, 5) / 6
    grid = ticks[:, None] + 1j * ticks
    crowd = grid.ravel()
    apart = crowd + 1e-3
    ax = hj.plot.multipliers(crowd, {"near": apart}).ax
    assert not ax.child_axes


def test_bands_hold_the_values(estimate):
    """Where there is a variance; the phase is drawn where it is known."""
    assert not hj.plot.htf(estimate).ax.collections
    variance = np.full(estimate.H.shape, 1e-6)
    sure = dataclasses.replace(estimate, variance=variance)
    radius = float(sure.confidence_radius().max())
    H_0 = sure[0][:, 0, 0]
    modulus = np.abs(H_0)

    (band,) = hj.plot.htf(sure, harmonics=(0,), output="yM").ax.collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert_allclose(heights.max(), modulus.max() + radius)

    axes = hj.plot.bode(sure, outputs="yM").axes
    upper, lower = axes[:, 0]
    phase = lower.get_lines()[0].get_ydata()
    assert_array_equal(np.isfinite(phase), modulus > radius)
    assert len(upper.collections) == 1
    assert len(lower.collections) == 1


@pytest.fixture(scope="module")
def found(hopper):
    rng_of_input = np.random.default_rng(0)
    u = 0.02 * rng_of_input.normal(size=(32 * 40, 1))
    y = np.asarray(hopper.simulate(u))
    rng = np.random.default_rng(1)
    size = 0.1 * y.std(axis=0)
    y = y + size * rng.normal(size=y.shape)
    return hj.validate(
        hopper, hj.experiments.SectionSeries(u, y, n_sections=32, outputs=("yM", "vM"))
    )


def test_validation_draws_signals_and_correlations(found):
    figure = found.plot(cycles=2).figure
    upper, lower = np.reshape(figure.axes, (2, 3))
    simulated, measured = lower[0].get_lines()
    simulated_end = found.simulated[-64:, 1]
    assert_array_equal(simulated.get_ydata(), simulated_end)
    measured_end = found.measured[-64:, 1]
    assert_array_equal(measured.get_ydata(), measured_end)
    cycles = 38 + np.arange(64) / 32
    assert_allclose(measured.get_xdata(), cycles)
    assert lower[0].get_ylabel() == r"$\delta$ vM"
    title = f"fit {found.fit[0]:.3g} %\n"
    assert upper[0].get_title("right") == title
    drawn = {upper[1]: found.autocorrelation, upper[2]: found.cross_correlation}
    for ax, correlation in drawn.items():
        bars = ax.collections[0].get_paths()
        heights = [bar.vertices[1, 1] for bar in bars]
        over_sections = correlation[:, :, 0].sum(axis=0)
        expected = over_sections.ravel() / np.sqrt(32)
        assert_allclose(heights, expected, atol=1e-12)


def test_no_texts_overlap_at_the_width_of_a_column(found):
    """None is cut."""
    with hj.plot.style():
        figure, axes = pyplot.subplots(2, 3, figsize=(3.5, 3.0), layout="constrained")
        found.plot(ax=axes)
        figure.canvas.draw()
    boxes = {}
    for text in figure.findobj(Text):
        words = text.get_text()
        is_tick = "mathdefault" in words
        if any(map(str.isalpha, words)) and not is_tick:
            boxes[text] = text.get_window_extent().padded(-1)
    assert len(boxes) == 13  # six titles, and seven labels of axes
    for text, box in boxes.items():
        assert figure.bbox.count_contains(box.corners()) == 4, f"{text} is cut"
    for a, b in itertools.combinations(boxes, 2):
        assert not boxes[a].overlaps(boxes[b]), f"{a} lies on {b}"


def test_the_interval_of_a_real_multiplier_has_ends_that_are_seen():
    value = 0.3
    half_width = 0.196  # of a 95 % interval
    estimate = MultiplierEstimate(
        np.array([value + 0j]), np.array([-value]), np.eye(1) / 100, np.inf
    )
    plot = hj.plot.multipliers([value], {"fit": estimate}, zoom=False)
    plot.figure.canvas.draw()
    picture = np.asarray(plot.figure.canvas.buffer_rgba())
    blue = [0, 0x72, 0xB2]
    apart = np.abs(picture[..., :3] - blue)
    distance = apart.sum(axis=2)
    is_blue = distance < 60
    for end in (value - half_width, value + half_width):
        place = plot.ax.transData.transform((end, 0)).round()
        column, height = place.astype(int)
        row = len(picture) - height
        rows = slice(row - 8, row + 8)
        columns = slice(column - 2, column + 3)
        cap = is_blue[rows, columns]
        pixels_high = cap.any(axis=1).sum()
        assert pixels_high > 6, "the line itself is one or two pixels high"


def test_regions_are_drawn_around_estimates(hopper):
    true = hopper.multipliers
    coefficients = np.poly(true).real[1:]
    covariance = 1e-4 * np.eye(2)
    estimate = MultiplierEstimate(true * 1.01, coefficients, covariance, np.inf)
    border = estimate.ellipse(0)
    (inset,) = hj.plot.multipliers(hopper, {"fit": estimate}).ax.child_axes
    ellipses = [line for line in inset.get_lines() if len(line.get_xdata()) == 100]
    drawn = ellipses[0].get_xydata() @ [1, 1j]
    assert_array_equal(drawn, border)
    (left, right) = inset.get_xlim()
    (low, high) = inset.get_ylim()
    assert left < border.real.min()
    assert border.real.max() < right
    assert low < border.imag.min()
    assert border.imag.max() < high

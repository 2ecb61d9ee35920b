import dataclasses
import itertools

import equinox as eqx
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from numpy.testing import assert_allclose, assert_array_equal

import hybridjax as hj
from hybridjax.identify.multiplier_estimate import MultiplierEstimate


def labeled(ax):
    """Lines by label, without the helpers that matplotlib or the axes hide."""
    return {
        line.get_label(): line for line in ax.get_lines() if line.get_label()[0] != "_"
    }


def test_magnitude_draws_the_values(estimate, exact):
    ax = hj.plot.magnitude(estimate, exact, output="vM").ax
    lines = labeled(ax)
    assert list(lines) == ["$H_{0}$", "$H_{1}$", "$H_{-1}$", "exact"]
    drawn = lines["$H_{1}$"]
    assert_array_equal(drawn.get_xdata(), estimate.f)
    assert_array_equal(drawn.get_ydata(), np.abs(estimate[1][:, 1, 0]))
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
    for draw in (
        hj.plot.magnitude,
        hj.plot.bode,
        lambda *x: hj.plot.harmonics({"a": x}),
    ):
        drawn = [
            [x.get_xydata() for x in draw(estimate, m).ax.lines]
            for m in (hopper, exact)
        ]
        for line, expected in zip(*drawn, strict=True):
            assert_allclose(line, expected, rtol=1e-9)
    with pytest.raises(hj.DefinitionError, match="model alone"):
        hj.plot.bode(hopper)
    hj.plot.bode(hopper.htf([0.3]))  # a single frequency


def test_harmonics_is_a_grid_of_outputs_and_families(estimate, exact):
    figure = hj.plot.harmonics({"isochron": (estimate, exact), "again": exact}).figure
    assert isinstance(figure, Figure)
    grid = np.reshape(figure.axes, (2, 2))
    assert [ax.get_title() for ax in grid[0]] == ["isochron", "again"]
    assert [ax.get_ylabel() for ax in grid[:, 0]] == ["$|H_m|$, yM", "$|H_m|$, vM"]
    assert [ax.get_title(loc="left") for ax in grid.ravel()] == list("ABCD")
    assert sum(ax.get_legend() is not None for ax in grid.ravel()) == 1
    assert grid[0, 0].get_ylim() == grid[0, 1].get_ylim()


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
    assert len(curves) == len(lower.get_lines()) == 2 * 4
    fitted = rational.htf(estimate.f).H[0, :, 0, 0]
    assert_allclose(curves[2].get_ydata(), np.abs(fitted))
    phases = [x.get_ydata() for x in lower.get_lines()]
    assert_allclose(phases[0], phases[3], atol=2)  # no curve is a whole turn away
    assert_allclose(phases[1], phases[0], atol=2)


def test_curves_of_one_input_and_output_lie_together_in_any_order_of_names():
    """Indices are those of the first HTF, and a fit is drawn over its own input."""
    exact = hj.testing.synthetic_ldtp().htf(np.linspace(0.05, 1.4, 12), 0)
    names = exact.inputs[::-1], exact.outputs[::-1]
    swapped = hj.HTF(
        exact.f, exact.H[..., ::-1, ::-1], 0, exact.n_sections, *names, "exact"
    )
    renamed = hj.HTF(
        exact.f, exact.H, 0, exact.n_sections, ("r", "s"), exact.outputs, "exact"
    )
    for draw, shown in ((hj.plot.magnitude, {"harmonics": [0]}), (hj.plot.bode, {})):
        first, second, *_ = draw(exact, swapped, input=1, **shown).ax.lines
        draw(exact, renamed, input=1, **shown)
        assert_allclose(first.get_ydata(), np.abs(exact[0][:, 0, 1]))
        assert_array_equal(first.get_ydata(), second.get_ydata())
    with pytest.raises(
        hj.DefinitionError, match=f"there is no input '{exact.inputs[0]}'"
    ):
        hj.plot.bode(exact, fits=hj.fit_rational(exact, input=1), input=0)


def test_every_input_is_drawn_and_named():
    exact = hj.testing.synthetic_ldtp().htf(np.linspace(0.05, 1.4, 12), 0)
    fit = hj.fit_rational(exact, input=1)
    assert len(exact.inputs) == 2
    pairs = [(i, j) for i in range(len(exact.outputs)) for j in range(2)]
    names = [f"{exact.outputs[i]} from {exact.inputs[j]}" for i, j in pairs]
    expected = [np.abs(exact[0][:, i, j]) for i, j in pairs]
    for draw in (hj.plot.bode, lambda *x, **y: hj.plot.bodes({"a": x}, **y)):
        upper = np.ravel(draw(exact).figure.axes)[0]
        curves = [x for x in upper.get_lines() if len(x.get_xdata())]
        for line, values in zip(curves, expected, strict=True):
            assert_allclose(line.get_ydata(), values)
        assert len({x.get_color() for x in curves}) == len(pairs)
        assert list(labeled(upper)) == [*names, "exact"]
    # A fit lies over the curves of its own input.
    with_fit = hj.plot.bode(exact, fits=fit).figure.axes[0].get_lines()
    fitted = [x for x in with_fit if len(x.get_xdata()) and x.get_color() == "black"]
    assert len(fitted) == len(exact.outputs)
    # Where one input is drawn, its name is on the axis.
    for draw in (hj.plot.magnitude, lambda x, **y: hj.plot.harmonics({"a": x}, **y)):
        for given, pushed in (({}, 0), ({"input": 1}, 1)):
            label = draw(exact, harmonics=[0], **given).figure.axes[0].get_ylabel()
            assert label.startswith(
                f"$|H_m|$, {exact.outputs[0]} from {exact.inputs[pushed]}"
            )


def test_bodes(estimate, exact, rational):
    families = {"a": (estimate, exact), "b": estimate}
    figure = hj.plot.bodes(families, fits={"b": rational}).figure
    measured = [len(ax.get_lines()) for ax in np.reshape(figure.axes, (2, 2))[1]]
    assert measured == [4, 4]
    with pytest.raises(hj.DefinitionError, match="`fits`: there is no name 'c'"):
        hj.plot.bodes(families, fits={"c": rational})


# The complex plane


def test_multipliers(hopper, rational, structured):
    ax = hj.plot.multipliers(hopper, {"2p1z": rational, "structured": structured}).ax
    lines = labeled(ax)
    assert [name.split(":")[0] for name in lines] == [
        "exact",
        "2p1z, yM",
        "2p1z, vM",
        "structured",
    ]
    z = hopper.multipliers
    expected = np.stack([z.real, z.imag], 1)
    assert_array_equal(lines["exact"].get_xydata(), expected)
    assert len({(x.get_marker(), x.get_color()) for x in lines.values()}) == 4
    assert f"{structured.compare(z).max_error:.1e}".split("e")[0] in list(lines)[-1]
    (inset,) = ax.child_axes
    (left, right) = inset.get_xlim()
    (low, high) = inset.get_ylim()
    for points in (z, *rational.multipliers, structured.multipliers):
        first = points[points.imag > 0][0]
        assert left < first.real < right
        assert low < first.imag < high
    crowd = (np.arange(-4, 5)[:, None] + 1j * np.arange(-4, 5)).ravel() / 6
    assert not hj.plot.multipliers(crowd, {"near": crowd + 1e-3}).ax.child_axes


def test_poles_and_zeros(rational):
    moved = eqx.tree_at(
        lambda fit: fit.zeros, rational, np.array([[np.nan + 0j], [0.9 + 0j]])
    )
    figure = hj.plot.poles_zeros({"isochron": rational, "kinematic": moved}).figure
    assert len(figure.axes) == 4
    for i, ax in enumerate(figure.axes[:2]):
        poles = labeled(ax)["poles, isochron"].get_xydata()
        assert_array_equal(poles[:, 1], rational.poles[i].imag)
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 4
    with pytest.raises(hj.DefinitionError, match="one or more fits"):
        hj.plot.poles_zeros({})


def test_experiment(hopper):
    design = hj.multisine(periods=4, band=(0, 2.0))
    data = hj.experiments.simulate_experiments(hopper, design, discard=2)
    figure = hj.plot.experiment(data, -1).figure
    assert [ax.get_ylabel() for ax in figure.axes] == [
        "u",
        r"$\delta$ yM",
        r"$\delta$ vM",
    ]
    y = figure.axes[2].get_lines()[0]
    assert_array_equal(y.get_ydata(), data.y[-1, :, 1])
    assert_allclose(y.get_xdata()[32], 1.0)
    assert "cycles" in figure.axes[2].get_xlabel()
    with pytest.raises(hj.DefinitionError, match="no experiment 99"):
        hj.plot.experiment(data, 99)


def test_saved_in_several_formats(tmp_path):
    plot = hj.plot.multipliers([0.5])
    png, pdf, svg = hj.plot.save(
        tmp_path / "multipliers.png", plot, ("png", "pdf", "svg")
    )
    assert png.read_bytes()[:4] == b"\x89PNG"
    assert pdf.read_bytes()[:5] == b"%PDF-"
    assert "<svg" in svg.read_text()
    expected = [f"multipliers.{x}" for x in ("png", "pdf", "svg")]
    assert [p.name for p in (png, pdf, svg)] == expected
    assert hj.plot.save(str(tmp_path / "v1.0"), plot.figure) == (tmp_path / "v1.0.png",)
    assert len(list(tmp_path.iterdir())) == 4
    assert isinstance(plot.figure.get_layout_engine(), ConstrainedLayoutEngine)
    with pytest.raises(hj.DefinitionError, match="x.bmp': formats are png"):
        hj.plot.save(tmp_path / "x.bmp", plot)


def test_bands_hold_the_values(estimate):
    """Where there is a variance; the phase is drawn where it is known."""
    sure = dataclasses.replace(estimate, variance=np.full(estimate.H.shape, 1e-6))
    assert not hj.plot.magnitude(estimate).ax.collections
    ax = hj.plot.magnitude(sure, harmonics=(0,)).ax
    radius = float(sure.confidence_radius().max())
    top = ax.collections[0].get_paths()[0].vertices[:, 1].max()
    assert_allclose(top, np.abs(sure[0][:, 0, 0]).max() + radius)
    upper, lower = hj.plot.bode(sure, outputs="yM").axes[:, 0]
    known = np.isfinite(lower.get_lines()[0].get_ydata())
    assert_array_equal(known, np.abs(sure[0][:, 0, 0]) > radius)
    assert len(upper.collections) == len(lower.collections) == 1


@pytest.fixture(scope="module")
def found(hopper):
    u = 0.02 * np.random.default_rng(0).normal(size=(32 * 40, 1))
    y = np.asarray(hopper.simulate(u))
    rng = np.random.default_rng(1)
    y = y + 0.1 * y.std(axis=0) * rng.normal(size=y.shape)
    return hj.validate(hopper, hj.Record(u, y, n_sections=32, outputs=("yM", "vM")))


def test_validation_draws_signals_and_correlations(found):
    grid = np.reshape(hj.plot.validation(found, cycles=2).figure.axes, (2, 3))
    simulated, measured = grid[1, 0].get_lines()
    assert_array_equal(simulated.get_ydata(), found.simulated[-64:, 1])
    assert_array_equal(measured.get_ydata(), found.measured[-64:, 1])
    assert_allclose(measured.get_xdata(), 38 + np.arange(64) / 32)
    assert grid[1, 0].get_ylabel() == r"$\delta$ vM"
    expected = f"fit {found.fit[0]:.3g} %\n"
    assert grid[0, 0].get_title("right") == expected
    for k, values in (
        (1, found.autocorrelation[:, :, 0]),
        (2, found.cross_correlation[:, :, 0]),
    ):
        heights = [
            path.vertices[1, 1] for path in grid[0, k].collections[0].get_paths()
        ]
        expected = values.sum(axis=0).ravel() / np.sqrt(32)
        assert_allclose(heights, expected, atol=1e-12)


def test_no_texts_overlap_at_the_width_of_a_column(found):
    """None is cut."""
    with hj.plot.style():
        figure, axes = pyplot.subplots(2, 3, figsize=(3.5, 3.0), layout="constrained")
        hj.plot.validation(found, ax=axes)
        figure.canvas.draw()
    texts = [
        x for x in figure.findobj(Text) if "mathdefault" not in x.get_text()
    ]  # no ticks
    words = [x for x in texts if any(map(str.isalpha, x.get_text()))]
    boxes = [x.get_window_extent().padded(-1) for x in words]
    assert len(boxes) == 13  # six titles, and seven labels of axes
    assert all(figure.bbox.count_contains(box.corners()) == 4 for box in boxes)
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_the_interval_of_a_real_multiplier_has_ends_that_are_seen():
    estimate = MultiplierEstimate(
        np.array([0.3 + 0j]), -np.ones(1) * 0.3, np.eye(1) / 100, np.inf
    )
    plot = hj.plot.multipliers([0.3], {"fit": estimate}, zoom=False)
    plot.figure.canvas.draw()
    picture = np.asarray(plot.figure.canvas.buffer_rgba())
    blue = np.abs(picture[..., :3] - [0, 0x72, 0xB2]).sum(axis=2) < 60
    for x in (0.3 - 0.196, 0.3 + 0.196):
        column, row = plot.ax.transData.transform((x, 0)).round().astype(int)
        cap = blue[len(blue) - row - 8 : len(blue) - row + 8, column - 2 : column + 3]
        assert cap.any(axis=1).sum() > 6  # pixels high, where the line is one or two


def test_regions_are_drawn_around_estimates(hopper):
    true = hopper.multipliers
    c = np.poly(true).real[1:]
    estimate = MultiplierEstimate(true * 1.01, c, 1e-4 * np.eye(2), np.inf)
    (inset,) = hj.plot.multipliers(hopper, {"fit": estimate}).ax.child_axes
    drawn = [
        line.get_xydata() for line in inset.get_lines() if len(line.get_xdata()) == 100
    ]
    assert_array_equal(drawn[0] @ [1, 1j], estimate.ellipse(0))
    (left, right) = inset.get_xlim()
    (low, high) = inset.get_ylim()
    border = estimate.ellipse(0)
    assert left < border.real.min() < border.real.max() < right
    assert low < border.imag.min() < border.imag.max() < high

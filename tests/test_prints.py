"""What objects print and show in notebooks: values with units, briefly, also where JAX hides them
or adds axes; and well-formed pages with escaped names."""

import re
import types
import xml.etree.ElementTree as ElementTree

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax._core.html import Curve, picture
from hybridjax._core.public import place_of
from hybridjax._core.text import p_value, rounded, standard_error
from hybridjax.experiments.data import Simulated
from hybridjax.orbits.branches import Bifurcation, Branch, BranchEnd
from hybridjax.systems.system import own_fields

from .conftest import APEX, KINEMATIC, OUTPUTS
from .toys import many


BYTES = 50_000  # the most that a page of a result may take


def shown(thing):
    """The texts of a page, and the number of its pictures: every tag that opens is closed."""
    page = thing._repr_html_()
    assert len(page) < BYTES
    assert "nan" not in page.replace("nanm", "")
    root = ElementTree.fromstring(f"<page>{page}</page>")
    tags = [x.tag.rpartition("}")[2] for x in root.iter()]
    return types.SimpleNamespace(
        texts=list(root.itertext()), pictures=tags.count("svg")
    )


@pytest.fixture(scope="module")
def hopper_data(kinematic_ldtp):
    design = hj.multisine(periods=16, frequencies=(0, 4.0))
    return hj.experiments.simulate_experiments(kinematic_ldtp, design)


@pytest.mark.parametrize("name", hj.models.__all__)
def test_systems_print_values_with_units(name):
    system = getattr(hj.models, name)()
    head, *lines = repr(system).splitlines()
    assert head == name
    assert len(lines) <= 16
    for field, line in zip(own_fields(system), lines, strict=True):
        value = float(getattr(system, field.name))
        number = f"{value:.6g} {field.metadata['unit']}".rstrip()
        assert line.split() == [
            field.name,
            *number.split(),
            *field.metadata["doc"].split(),
        ]


def test_many_systems_print_their_number_and_range():
    hoppers = eqx.filter_vmap(lambda k: hj.models.VerticalHopper(k=k))(
        jnp.linspace(8.0, 13.0, 100)
    )
    text = " ".join(repr(hoppers).split())
    assert "k 100 numbers, 8 to 13 N/m" in text
    assert "M 100 numbers, all 2 kg" in text


def test_under_transformations(hopper_cycle, placed_kinematic, kinematic_ldtp):
    printed = []
    pages = []

    @jax.jit
    def look(k):
        written = (
            hj.models.VerticalHopper(k=k),
            hj.orbits.Settings(rtol=k),
            hj.ClockPhase(8, anchor=k),
        )
        guess = hj.Guess("stance", (k, 0.0), k)
        printed.extend(map(repr, (*written, guess)))
        for thing in (
            hopper_cycle,
            placed_kinematic,
            kinematic_ldtp,
            kinematic_ldtp.htf([0.1]),
        ):
            traced = jax.tree_util.tree_map(
                lambda x: x * k.astype(x.dtype) if eqx.is_array(x) else x, thing
            )
            pages.append(traced._repr_html_())
        return k

    look(jnp.ones(()))
    for text in printed:
        assert "traced float64[" in text
    assert pages == [None] * 4


def test_definitions_print_as_they_are_written():
    written = [
        "ClockPhase(n_sections=8, anchor=0.25)",
        "Crossing(signal='vM', direction='falling', value=0)",
        "AtEvent(name='touchdown')",
        "Guess(chart='stance', state=(2, 1.9), time=0.5)",
        "Settings(rtol=1e-09, atol=1e-12, max_steps=99)",
        "Scheduled(period=2, offset=0.5)",
    ]
    for text in written:
        name = text.partition("(")[0]
        place = place_of(name).rpartition(".")[0]
        made = eval(f"{place}.{text}")
        assert repr(made) == text
    key = jax.random.key(0)
    network = eqx.nn.MLP(2, 1, 8, 1, key=key)

    class Learned(hj.models.VerticalHopper):
        term: eqx.nn.MLP = None

    assert repr(Learned(term=network)).splitlines()[-1].split() == [
        "term",
        "MLP(33",
        "numbers)",
    ]


def test_results_print_briefly(
    hopper_cycle, placed_kinematic, kinematic_ldtp, hopper_data
):
    response = hj.experiments.response_function(hopper_cycle, placed_kinematic, OUTPUTS)
    htf = kinematic_ldtp.htf([0.1, 0.2])
    things = [
        hopper_cycle,
        hopper_cycle.trajectory(),
        placed_kinematic,
        kinematic_ldtp,
        htf,
        hopper_data,
        KINEMATIC,
        response,
        hj.sections.section_map(hopper_cycle, placed_kinematic, 0, 5),
        hj.fitting.ObservedHTF(htf, KINEMATIC),
        hj.fitting.ObservedSeries(hopper_data, KINEMATIC),
        hj.fitting.ObservedCycle(KINEMATIC, period=1.0),
        Simulated(np.zeros(3, int)),
    ]
    for thing in things:
        text = repr(thing)
        widths = [len(line) for line in repr(thing).splitlines()]
        assert len(widths) <= 12
        assert max(widths) <= 100
        assert text.startswith(type(thing).__name__)
        assert "f64[" not in text
        assert "array(" not in text
    assert "period       1 s" in repr(hopper_cycle)
    assert "yM = 1.96504037 m, " in repr(hopper_cycle)
    assert "u (N) -> yM (m), vM (m/s)" in repr(hopper_data)


@pytest.mark.slow
def test_results_show_pages(hopper_cycle, placed_kinematic, kinematic_ldtp):
    m = kinematic_ldtp
    end = BranchEnd(1.0, hj.errors.Result.OK, "the <values> end")
    model = hj.linear.LDTP(
        m.A, m.B, m.C, m.D, m.dims, inputs="<u>", outputs=("yM & co", "vM")
    )
    multipliers = np.array([-1.0 + 0j, 0.5])
    point = Bifurcation("flip", 1, 2.0, multipliers)
    branch = Branch(
        "k", np.array([1.0, 2.0]), many(hopper_cycle, 2), (point,), (end, end)
    )
    t = np.linspace(0.0, 20.0, 2001)
    tt, *values = hopper_cycle.trajectory()("yM", "vM")
    wobble = 1 + 1e-6 * np.sin(t)
    y, v = (np.interp(t, tt, x, period=1.0) * wobble for x in values)
    signals = {"<u>": np.cos(3 * t), "yM & co": y, "vM": v}
    events = {"<hit>": [1.0]}
    recording = hj.Recording(t, signals, units={"vM": "m/s"}, events=events, name="<i>")
    data = hj.recordings.sample_sections(
        recording, APEX, inputs="<u>", outputs=("yM & co", "vM"), n_sections=8
    )
    f = np.linspace(0.05, 5, 300)
    for thing, texts, pictures in (
        (
            hopper_cycle,
            ["-0.248983+0.699333j", "1 s", "liftoff, touchdown", "yM (m)"],
            2,
        ),
        (placed_kinematic, ["27 in flight, 5 in stance", "2 to 4"], 1),
        (branch, ["flip", "2", "-1", "the <values> end"], 1),
        (model, ["<u>", "yM & co, vM"], 1),
        (model.htf(f, (-2, -1, 0, 1, 2)), ["H_-2", "|H|, <u> to vM"], 2),
        (model.htf([0.05], (0, 1)), [], 2),  # of one frequency there is no curve
        (data, [], 3),
    ):
        page = shown(thing)
        assert page.pictures == pictures
        assert set(texts) <= {*page.texts, *(x.split(" (")[0] for x in page.texts)}
    assert any("rms deviations: <u> " in x for x in page.texts)


def test_fits_show_standard_errors():
    A = [[[0.6, 0.5], [-0.5, 0.6]]] * 4
    B = [[[1.0], [0.3]]] * 4
    C = [[[1.0, 0.0], [0.2, 1.0]]] * 4
    model = hj.linear.LDTP(A, B, C, inputs="<u>", outputs=("yM & co", "vM"))
    rng = np.random.default_rng(0)
    u = rng.normal(size=(600, 1))
    response = np.asarray(model.simulate(u))
    y = response + 1e-2 * rng.normal(size=(600, 2))
    record = hj.experiments.SectionSeries(
        u, y, n_sections=4, inputs=model.inputs, outputs=model.outputs
    )
    fit = hj.fit_series(record, order=2)
    page = shown(fit)
    errors = [x for x in page.texts if re.fullmatch(r"0\.0+\d\d", x)]
    assert_allclose([float(x) for x in errors], fit.standard_errors, rtol=0.05)
    assert re.findall(r"± (\S+?)[,;]", repr(fit)) == errors  # one meaning in both
    assert any(x.startswith("noise yM & co ") for x in page.texts)
    assert shown(hj.validate(fit, record)).pictures == 1
    f = np.linspace(0.05, 1.9, 30)
    htf = model.htf(f, harmonics=(0,))
    assert "yM & co: multipliers" in "".join(shown(hj.identify.fit_rational(htf)).texts)


def test_pictures_are_xml_whatever_is_drawn():
    x = np.arange(10.0)
    pictures = [
        picture([Curve(x, x)], "<x>", "y & z"),
        picture([Curve(x, np.where(x == 3, np.nan, 1e9 + 1e-3 * x), "<name>")]),
        picture([Curve(x, np.zeros(10))], log=True),
        picture([Curve(x, 10.0**-x)], log=True),
        picture([Curve(np.full(3, np.nan), x[:3])]),
        picture([Curve(x, np.zeros(10)), Curve(x, x, points=True)], square=True),
        picture([]),
    ]
    empty = [p == "" for p in pictures]
    assert empty == [False, False, True, False, True, False, True]
    for one in filter(None, pictures):
        ElementTree.fromstring(one)
    drawing = ElementTree.fromstring(pictures[1])
    labels = [t.text for t in drawing.findall(".//{*}text")]
    assert len(set(labels)) == len(labels) > 4  # numbers on an axis can be told apart


def test_p_values_have_few_digits():
    given = {
        4e-11: "p < 0.001",
        0.001: "p = 0.001",
        0.0314: "p = 0.031",
        0.997: "p > 0.99",
    }
    assert {p: p_value(p) for p in given} == given


@pytest.mark.parametrize(
    "value, error, text",
    [
        (9.99, 0.0012, "9.9900 ± 0.0012"),
        (-0.2489207 + 0.6992677j, 6.9e-5, "-0.248921+0.699268j ± 0.000069"),
        (0.742, 0.0996, "0.74 ± 0.10"),
        (12345.0, 230.0, "12340 ± 230"),
        (1e-9, 1.3e-11, "1.000e-09 ± 1.3e-11"),
        (-0.0001, 0.012, "-0.00010 ± 0.012"),
        (0.5, 12.0, "0.50 ± 12"),
        (18.6540553, np.inf, "18.7 ± unknown"),
        (0.5, np.nan, "0.5 ± unknown"),
        (0.123456, 4.1e-7, "0.12345600 ± 4.1e-07"),
    ],
)
def test_values_have_the_digits_that_their_errors_leave(value, error, text):
    assert f"{rounded(value, error)} ± {standard_error(error)}" == text


def test_values_without_errors_have_nine_digits():
    assert rounded(1 / 3, np.nan) == rounded(1 / 3, 0.0) == "0.333333333"


def test_prints_are_true():
    odd = hj.multisine(8, periods=16, lines="odd")
    steps = np.diff(odd.frequencies * 16).round()
    assert set(steps.astype(int)) >= {2}
    assert "in steps of 1/8" in repr(odd)
    assert "in steps of 1/16" in repr(hj.multisine(8, periods=16))
    alone = hj.experiments.Design.from_lines([[0.1]], 1.0, n_sections=8, periods=10)
    assert "steps" not in repr(alone)
    model = hj.linear.LDTP([[[0.5]]], [[[1.0]]], [[[1.0]]])
    assert "; 1 frequency 0.1 cycles/period; " in repr(model.htf([0.1]))
    assert "; 2 frequencies 0.1 to 0.2 cycles/period; " in repr(model.htf([0.1, 0.2]))

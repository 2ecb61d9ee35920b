"""What results show in notebooks: well-formed, small, with escaped names, whatever they hold."""

import types
import xml.etree.ElementTree as ElementTree

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core.html import Curve, picture
from hybridjax.orbits.continuation import Branch, BranchEnd, BranchPoint

from .toys import many


BYTES = 50_000  # the most that a result may take


def shown(thing):
    """The texts of a page, and the number of its pictures: every tag that opens is closed."""
    page = thing._repr_html_()
    assert len(page) < BYTES and "nan" not in page.replace("nanm", "")
    root = ElementTree.fromstring(f"<page>{page}</page>")
    tags = [x.tag.rpartition("}")[2] for x in root.iter()]
    return types.SimpleNamespace(texts=list(root.itertext()), pictures=tags.count("svg"))


@pytest.fixture(scope="module")
def model(kinematic_ldtp):
    m = kinematic_ldtp
    return hj.LDTP(m.A, m.B, m.C, m.D, m.dims, inputs="<u>", outputs=("yM & co", "vM"))


@pytest.fixture(scope="module")
def recording(hopper_cycle):
    t = np.linspace(0.0, 20.0, 2001)
    tt, *values = hopper_cycle.trajectory()("yM", "vM")
    y, v = (np.interp(t, tt, x, period=1.0) for x in values)
    signals = {"<u>": np.cos(3 * t), "yM & co": y, "vM": v}
    return hj.Recording(t, signals, units={"vM": "m/s"}, events={"<hit>": [1.0]}, name="<i>")


def test_cycles_and_sections(hopper_cycle, placed_kinematic):
    cycle, placed = shown(hopper_cycle), shown(placed_kinematic)
    assert {"-0.248983 + 0.699333i", "1 s", "liftoff, touchdown", "yM (m)"} <= set(cycle.texts)
    assert cycle.pictures == 2 and placed.pictures == 1
    assert {"27 in flight, 5 in stance", "2 to 4"} <= set(placed.texts)


def test_branches(hopper_cycle):
    cycles = many(hopper_cycle, 2)
    point = BranchPoint("flip", 1, 2.0, np.array([-1.0 + 0j, 0.5]))
    end = BranchEnd(1.0, hj.Result.OK, "the <values> end")
    branch = shown(Branch("k", np.array([1.0, 2.0]), cycles, (point,), (end, end)))
    assert {"flip", "2", "-1", "the <values> end"} <= set(branch.texts) and branch.pictures == 1


def test_linear_models_and_transfer_functions(model):
    page = shown(model)
    assert {"<u>", "yM & co, vM (m/s)"} & set(page.texts) and page.pictures == 1
    htf = model.htf(np.linspace(0.05, 5, 300), harmonics=(-2, -1, 0, 1, 2))
    page = shown(htf)
    assert page.pictures == 2 and {"H_-2", "|H|, <u> to vM"} <= {
        x.split(" (")[0] for x in page.texts
    }
    assert shown(model.htf([0.05], (0, 1))).pictures == 2  # of one frequency there is no curve


def test_fits():
    A, B, C = [[[0.6, 0.5], [-0.5, 0.6]]] * 4, [[[1.0], [0.3]]] * 4, [[[1.0, 0.0], [0.2, 1.0]]] * 4
    model = hj.LDTP(A, B, C, inputs="<u>", outputs=("yM & co", "vM"))
    rng = np.random.default_rng(0)
    u = rng.normal(size=(600, 1))
    y = np.asarray(model.simulate(u)) + 1e-2 * rng.normal(size=(600, 2))
    record = hj.Record(u, y, n_sections=4, inputs=model.inputs, outputs=model.outputs)
    fit = hj.fit_series(record, order=2)
    page = shown(fit)
    said = [tuple(map(float, x.split(" ± "))) for x in page.texts if " ± " in x]
    parts = np.stack([fit.multipliers.real, fit.multipliers.imag], axis=1)
    values, widths = np.reshape(said, (2, 2, 2)).transpose(2, 0, 1)
    np.testing.assert_allclose(widths, fit.half_widths(), rtol=0.1)
    assert (np.abs(values - parts) < 0.1 * widths).all()
    assert any(x.startswith("noise yM & co ") for x in page.texts)
    assert shown(hj.validate(fit, record)).pictures == 1
    htf = model.htf(np.linspace(0.05, 1.9, 30), harmonics=(0,))
    assert "yM & co: multipliers" in "".join(shown(hj.fit_rational(htf)).texts)


def test_recordings(recording):
    apex = hj.Crossing("vM", "falling")
    data = hj.recordings.section_data(
        recording, apex, inputs="<u>", outputs=("yM & co", "vM"), n_sections=8
    )
    page = shown(data)
    assert any("rms deviations: <u> " in x for x in page.texts) and page.pictures == 3


def test_what_jax_traces_has_no_page(hopper_cycle, placed_kinematic, kinematic_ldtp):
    pages = []

    @jax.jit
    def look(k):
        for thing in (hopper_cycle, placed_kinematic, kinematic_ldtp, kinematic_ldtp.htf([0.1])):
            traced = jax.tree_util.tree_map(
                lambda x: x * k.astype(x.dtype) if eqx.is_array(x) else x, thing
            )
            pages.append(traced._repr_html_())
        return k

    look(jnp.ones(()))
    assert pages == [None] * 4


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
    assert [p == "" for p in pictures] == [False, False, True, False, True, False, True]
    for one in filter(None, pictures):
        ElementTree.fromstring(one)
    labels = [t.text for t in ElementTree.fromstring(pictures[1]).findall(".//{*}text")]
    assert len(set(labels)) == len(labels) > 4  # numbers on an axis can be told apart

import json
import operator
import os
import pickle

import jax
import numpy as np
import pytest
import scipy
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.testing import assert_array_equal

import hybridjax as hj
from hybridjax.experiments.data import Simulated

from .linear.test_variances import htf as htf


def same(a, b):
    """Equal types, names, dtypes and bits."""
    assert type(a) is type(b)
    for name in type(a).__dataclass_fields__:
        x = getattr(a, name)
        y = getattr(b, name)
        assert isinstance(x, jax.Array) == isinstance(y, jax.Array)
        if hasattr(x, "dtype"):
            x = np.asarray(x)
            y = np.asarray(y)
            assert x.dtype == y.dtype
            assert x.shape == y.shape
            assert x.tobytes() == y.tobytes()
        else:
            # also units
            assert x == y
            assert str(x) == str(y)
    return True


def trip(folder, thing):
    path = folder / "thing.npz"
    hj.save(path, thing)
    return hj.load(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("io")


@pytest.fixture(scope="module")
def ldtp():
    rng = np.random.default_rng(0)
    shapes = ((3, 2), (2, 3))
    A = [rng.normal(size=s) / 4 for s in shapes]
    B = [rng.normal(size=(3, 2)), rng.normal(size=(2, 2))]
    C = [np.ones((1, 2)), np.ones((1, 3))]
    names = (("x", "v"), ("x", "v", "z"))
    return hj.linear.LDTP.from_blocks(
        A,
        B,
        C,
        inputs={"force": "N", "torque é": ""},
        outputs={"y": "m"},
        coordinates=names,
    )


@pytest.fixture(scope="module")
def things(ldtp, htf):
    design = hj.multisine(
        n_sections=2, periods=16, frequencies=(0, 1.0), inputs=ldtp.inputs
    )
    data = hj.experiments.simulate_experiments(ldtp, design)
    estimate = hj.estimate_htf(data)
    plain = hj.linear.LDTP(ldtp.A, ldtp.B, ldtp.C, dims=ldtp.dims)
    fits = (
        hj.identify.fit_rational(estimate),
        hj.fit_multipliers(estimate, ldtp, extra_lags=2),
    )
    record = hj.experiments.SectionSeries(
        data.u[0], data.y[0], n_sections=2, first_section=1
    )
    series = hj.fit_series(data, ldtp, extra_lags=2)
    y = np.ones((2, 6, 1))
    y[1, 3:] = np.nan
    failed = hj.experiments.ExperimentData(
        np.zeros((2, 6, 1)),
        y,
        n_sections=3,
        periods=1,
        result=[0, hj.errors.Result.GRAZING],
        simulated=Simulated(np.array([-1, 3]), np.array([1e-9, 2e-9]), "by hand"),
        cycle_outputs=np.arange(3.0)[:, None],
    )
    object.__setattr__(
        failed, "periods", np.int64(1)
    )  # as where nobody checks annotations
    return [design, data, estimate, ldtp, plain, *fits, record, series, htf, failed]


def test_every_kind_comes_back_bit_by_bit(folder, things, htf):
    backs = [trip(folder, thing) for thing in things]
    assert all(map(same, things, backs))
    assert type(backs[-1].periods) is int
    summary = things[-1].summary()
    assert backs[-1].summary() == summary
    assert {p.name for p in folder.iterdir()} == {"thing.npz"}
    xarray = pytest.importorskip("xarray")
    for thing in things:
        dataset = hj.convert.to_xarray(thing)
        assert isinstance(dataset, xarray.Dataset)
        assert same(hj.convert.from_xarray(dataset), thing)
        assert same(
            hj.convert.from_xarray(xarray.Dataset.from_dict(dataset.to_dict())), thing
        )
    dataset = hj.convert.to_xarray(htf)
    assert dataset["variance_dof.roundness"].dims == (
        "harmonic",
        "frequency",
        "output",
        "input",
    )


@settings(max_examples=15)
@given(st.data())
def test_round_trip_of_any_htf(folder, data):
    F, ny, nu = data.draw(array_shapes(min_dims=3, max_dims=3, max_side=3))
    harmonics = data.draw(st.sets(st.integers(-3, 3), min_size=1).map(sorted))
    finite = st.complex_numbers(
        allow_nan=False, allow_infinity=False, max_magnitude=1e300
    )
    shape = (len(harmonics), F, ny, nu)
    H = data.draw(arrays(complex, shape, elements=finite))
    numbers = st.floats(-1e300, 1e300)
    f = data.draw(
        st.lists(numbers, min_size=F, max_size=F, unique_by=lambda x: round(x, 6))
    )
    words = st.text().map("y".__add__)  # (no input's name)
    names = data.draw(st.lists(words, min_size=ny, max_size=ny, unique=True))
    method = data.draw(st.text())
    htf = hj.linear.HTF(f, H, harmonics, 7, None, names, method)
    assert same(htf, trip(folder, htf))


@settings(max_examples=50)
@given(st.data())
def test_damaged_files_are_refused_or_harmless(folder, things, data):
    place = data.draw(st.integers(0, len(things) - 1))
    thing = things[place]
    path = folder / "damaged.npz"
    hj.save(path, thing)
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        end = data.draw(st.integers(0, len(content) - 1))
        content = content[:end]
    else:
        # Half of the flips in the archive's directory at the end, where checksums do not reach.
        late = max(0, len(content) - 700)
        low = data.draw(st.sampled_from([0, late]))
        for k in data.draw(
            st.lists(st.integers(low, len(content) - 1), min_size=1, max_size=3)
        ):
            content[k] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    try:
        assert same(thing, hj.load(path))
    except hj.errors.FileFormatError as error:
        assert str(path) in str(error)


class _Trap:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was executed",))


def rewrite(path, header=None, arrays=None):
    """Change a saved file as an editor of its content could, with valid checksums."""
    with np.load(path) as file:
        content = dict(file)
    old = json.loads(str(content.pop("header")))
    content.update(arrays or {})
    old["arrays"].update({name: "" for name in arrays or {}})
    merged = {**old, **(header or {})}
    header_text = json.dumps(merged)
    np.savez(path, header=np.array(header_text), **content)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"header": {"format_version": 9, "package_version": "9.0"}},
            "version 9.* hybridjax 9.0",
        ),
        ({"header": {"format": "other"}}, "not written by `hj.save`"),
        ({"header": {"kind": "os.system"}}, "holds a 'os.system'; `load` reads Design"),
        ({"header": {"kind": "LDTP"}}, "not those of LDTP"),
        ({"header": {"static": 3}}, "header is incomplete"),
        ({"header": {"arrays": {}}}, "header lists"),
        ({"arrays": {"source": np.zeros(2)}}, "not those of HTF"),
        ({"arrays": {"frequencies": np.array(["a"])}}, "content is no HTF"),
    ],
)
def test_foreign_content(folder, things, change, says):
    path = folder / "foreign.npz"
    hj.save(path, things[2])
    rewrite(path, **change)
    with pytest.raises(hj.errors.FileFormatError, match=says):
        hj.load(path)


def test_pickles_are_not_executed(folder, things):
    path = folder / "trap.npz"
    hj.save(path, things[2])
    trap = np.array([_Trap()], dtype=object)
    rewrite(path, arrays={"H": trap})
    with pytest.raises(hj.errors.FileFormatError, match="damaged"):
        hj.load(path)
    path.write_bytes(pickle.dumps(_Trap()))
    with pytest.raises(hj.errors.FileFormatError, match="is damaged, or no npz file"):
        hj.load(path)


def test_a_matlab_file(folder, ldtp, htf):
    for thing, names in ((ldtp, "A dims"), (htf, "H variance_dof.dof")):
        hj.save(folder / "thing.mat", thing)
        read = scipy.io.loadmat(folder / "thing.mat")
        for name in names.split():
            value = operator.attrgetter(name)(thing)
            written = read[name.replace(".", "_")]
            assert_array_equal(written.squeeze(), np.squeeze(value))
        stored = json.loads(read["header"].item())
        assert stored["kind"] == type(thing).__name__


def test_where_nothing_can_be_written_or_read(folder, things):
    with pytest.raises(hj.errors.DefinitionError, match="end in '.npz'"):
        hj.save(folder / "data.txt", things[0])
    (folder / "taken.npz").mkdir()
    with pytest.raises(
        hj.errors.DefinitionError, match="cannot write .*Is a directory"
    ):
        hj.save(folder / "taken.npz", things[0])
    os.mkfifo(folder / "pipe.npz")
    for name, problem in (
        ("absent", "cannot read .*No such file"),
        ("pipe", "is empty"),
    ):
        with pytest.raises(hj.errors.HybridJaxError, match=problem):
            hj.load(folder / f"{name}.npz")
    hidden = [p for p in folder.iterdir() if p.name.startswith(".")]
    assert not hidden


def test_traced_and_batched_objects(folder, ldtp):
    def inside(f):
        hj.save(folder / "x.npz", ldtp.htf(f))
        return f

    with pytest.raises(hj.errors.DefinitionError, match="outside of jit"):
        jax.jit(inside)(np.zeros(1))
    frequencies = np.linspace(0.1, 0.4, 4).reshape(2, 2)
    batch = jax.vmap(lambda f: ldtp.htf(f))(frequencies)
    with pytest.raises(
        hj.errors.DefinitionError, match="cannot be saved: its frequencies is float64"
    ):
        hj.save(folder / "x.npz", batch)

"""All that this package takes from parts of JAX and NumPy that may change.

If a test fails with a version of JAX that is not in `TESTED`, the docstring of the function in
`_core/jax_compat.py` says what no longer works.
"""

import pathlib
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core import jax_compat

from ..sessions import run_python


hj.enable_x64()
# Versions of JAX with which all tests of this file have passed.
TESTED = ("0.10.1",)

X = jnp.arange(1.0, 4.0)
MATRIX = jnp.eye(3) + 0.1


def program_of(function, *arguments):
    return jax.make_jaxpr(function)(*arguments).jaxpr


def only_equation(function, *arguments):
    (equation,) = program_of(function, *arguments).eqns
    return equation


def test_version():
    if jax.__version__ not in TESTED:
        warnings.warn(f"JAX {jax.__version__}: add it to TESTED.", stacklevel=1)


# Modules, JAX's configuration, names of primitives, options of XLA, and names of files.
MOVING = (
    r"jax\._src|jax\.(core|extend|interpreters|experimental)\b|from jax import .*core|"
    r"jax\.config|primitive\.name ==|primitive\.name in|primitives\b.*_p\b|source_info|"
    r"custom_[jv]+p_call|closed_call|\"(pjit|dot_general|select_n|integer_pow)\"|"
    r"dce_jaxpr|eval_context|\"xla_|@lapack|opaque_trace|numpy\._typing|-\[ac\]\*e"
)


def test_no_other_file_leans_on_moving_parts():
    root = pathlib.Path(hj.__file__).parent
    for file in sorted(root.rglob("*.py")):
        if file.name == "jax_compat.py":
            continue
        for number, line in enumerate(file.read_text().splitlines(), 1):
            assert not re.search(MOVING, line), f"{file.name}:{number}: {line.strip()}"


def test_the_search_for_moving_parts_finds_them():
    text = pathlib.Path(jax_compat.__file__).read_text()
    for part in ("jax.core", "jax.extend", "dce_jaxpr", "source_info", '"xla_'):
        assert part in text and re.search(MOVING, part), part


# Programs ---------------------------------------------------------------------------------------


def test_primitives_of_inner_programs():
    def function(x):
        loop = jax.lax.fori_loop(0, 3, lambda _, y: jnp.sin(y), x)
        return jax.jit(jnp.linalg.solve)(MATRIX, loop)

    names = jax_compat.primitives_of(program_of(function, X))
    assert {"sin", "lu", "triangular_solve"} <= names


def test_needed_part():
    program = program_of(lambda x, y, z: (jnp.sin(y), 0 * x)[0], 1.0, 2.0, 3.0)
    needed, uses = jax_compat.needed_part(program)
    assert uses == [False, True, False]
    assert len(needed.invars) == 1
    needed, _ = jax_compat.needed_part(program, every_argument=True)
    assert len(needed.invars) == 3
    assert jax_compat.primitives_of(needed) == {"sin"}


def test_changed_programs_run():
    whole = jax.make_jaxpr(lambda x: jnp.sin(x) + 1.0)(2.0)
    first, second = whole.jaxpr.eqns
    cosine = jax_compat.in_place_of(first, only_equation(jnp.cos, 2.0), first.invars)
    program = jax_compat.with_equations(whole.jaxpr, [cosine, second])
    run = jax_compat.as_function(jax_compat.with_program(whole, program))
    found = run(2.0)[0]
    expected = np.cos(2.0) + 1.0
    np.testing.assert_allclose(found, expected)


def test_variables_and_constants():
    equation = only_equation(lambda x: x + 1.0, 2.0)
    x, one = equation.invars
    assert jax_compat.is_variable(x)
    assert not jax_compat.is_constant(x)
    assert jax_compat.is_constant(one)
    assert one.val == 1.0
    assert jax_compat.bits_of(x) == 64
    doubled = only_equation(lambda k: k + k, 1)
    bits = jax_compat.bits_of(doubled.invars[0])
    assert bits is None


def test_lines_of_an_equation():
    lines = jax_compat.lines_of(only_equation(lambda x: jnp.sin(x), 1.0))
    here = [line for file, line in lines if file == __file__]
    source = pathlib.Path(__file__).read_text()
    text = source.splitlines()[here[0] - 1]
    assert "jnp.sin(x)" in text


# What primitives do -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", "sin cos tan arctan arcsin arccos".split())
def test_names_of_functions(name):
    equation = only_equation(
        lambda x: getattr(jax.lax, name.replace("arc", "a"))(x), 0.5
    )
    assert jax_compat.function_of(equation) == name


def test_names_of_other_functions():
    angle = only_equation(jax.lax.atan2, 1.0, 2.0)
    assert jax_compat.function_of(angle) == "arctan2"
    joined = only_equation(lambda x: jax.lax.concatenate([x, x], 0), X)
    assert jax_compat.function_of(joined) == "vector"
    assert jax_compat.function_of(only_equation(jax.lax.exp, 1.0)) == ""


def test_requested_accuracy():
    mode = jax.lax.AccuracyMode.HIGHEST
    chosen = only_equation(lambda x: jax.lax.sin(x, accuracy=mode), 1.0)
    assert jax_compat.is_rounded(chosen)
    assert not jax_compat.is_rounded(only_equation(jax.lax.sin, 1.0))


def test_parts_of_a_linear_system():
    program = program_of(jnp.linalg.solve, MATRIX, X)
    while all(jax_compat.function_of(x) != "solve" for x in program.eqns):
        (program,) = (p for x in program.eqns for p in jax_compat.inner_programs(x))
    (system,) = [x for x in program.eqns if jax_compat.function_of(x) == "solve"]
    matrix, right, factors, product = jax_compat.solved_by(system)
    assert matrix.aval.shape == (3, 3)
    assert right.aval.shape == (3,)
    assert factors
    assert jax_compat.function_of(product) == "product"


def test_calls_and_rules():
    jitted = only_equation(jax.jit(jnp.sin), 1.0)
    assert jax_compat.is_call(jitted)
    assert jax_compat.is_outer(jitted)

    @jax.custom_jvp
    def with_rule(x):
        return x

    with_rule.defjvp(lambda x, dx: (x[0], dx[0]))
    assert jax_compat.has_rule(only_equation(with_rule, 1.0))

    @jax.custom_vjp
    def with_reverse_rule(x):
        return x

    with_reverse_rule.defvjp(lambda x: (x, None), lambda _, y: (y,))
    assert jax_compat.is_hosted(only_equation(with_reverse_rule, 1.0))

    def callback(x):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), float), x)

    assert jax_compat.is_hosted(only_equation(callback, 1.0))


def test_loops_without_a_transpose():
    def power(x):
        return jax.lax.while_loop(lambda y: y < 10, lambda y: x * y, x)

    with pytest.raises(ValueError) as caught:
        jax.grad(power)(2.0)
    assert jax_compat.lacks_transpose(caught.value)
    assert not jax_compat.lacks_transpose(ValueError("of another kind"))


def test_zeros_and_bits():
    product = only_equation(lambda x: 0.0 * x, 1.0)
    assert jax_compat.gives_zero(product, [True, False])
    assert not jax_compat.gives_zero(product, [False, False])
    assert jax_compat.works_on_bits(only_equation(lambda k: k << k, 1))


SUDDEN = {
    "pole": lambda x, y: x / y,
    "decision": lambda x, y: x > y,
    "kink": jnp.maximum,
    "power": lambda x, y: jax.lax.integer_pow(x, 3),
    "otherwise": lambda x, y: jax.lax.exp(x),
}


@pytest.mark.parametrize("how", SUDDEN)
def test_suddenness(how):
    (equation, *_) = program_of(SUDDEN[how], 1.0, 2.0).eqns
    while jax_compat.inner_programs(equation):
        (equation,) = jax_compat.inner_programs(equation)[0].eqns
    varies = [True] * len(equation.invars)
    found = jax_compat.suddenness(equation, varies)
    assert found == [how]


def test_smooth_operations():
    smooth = program_of(lambda x: jnp.sum(x * jnp.sin(x) - 1.0), X)
    for equation in smooth.eqns:
        varies = [True] * len(equation.invars)
        assert jax_compat.suddenness(equation, varies) == []


# LAPACK -----------------------------------------------------------------------------------------

FACTORIZATIONS = {
    "cholesky": jnp.linalg.cholesky,
    "eig": lambda x: jnp.linalg.eig(x)[0],
    "eigh": lambda x: jnp.linalg.eigh(x)[0],
    "expm": jax.scipy.linalg.expm,
    "hessenberg": lambda x: jax.lax.linalg.hessenberg(x)[0],
    "householder": lambda x: jax.lax.linalg.householder_product(x, x[0]),
    "inv": jnp.linalg.inv,
    "lu": lambda x: jax.lax.linalg.lu(x)[0],
    "qr": lambda x: jnp.linalg.qr(x)[0],
    "schur": lambda x: jax.lax.linalg.schur(x)[0],
    "solve": lambda x: jnp.linalg.solve(x, x),
    "svd": lambda x: jnp.linalg.svd(x)[1],
    "triangular": lambda x: jax.scipy.linalg.solve_triangular(x, x),
    "tridiagonal": lambda x: jax.lax.linalg.tridiagonal(x)[0],
    "tridiagonal_solve": lambda x: jax.lax.linalg.tridiagonal_solve(
        x[0], x[0], x[0], x
    ),
}


@pytest.mark.parametrize("name", FACTORIZATIONS)
@pytest.mark.parametrize("inside", [False, True])
def test_programs_of_lapack_are_recognized(name, inside):
    """The text that XLA is given has the names of LAPACK's functions: no program with them may be
    missed, also inside of loops."""

    def function(x):
        if inside:
            return jax.lax.map(FACTORIZATIONS[name], x[None])[0]
        return FACTORIZATIONS[name](x)

    traced = jax.jit(function).trace(MATRIX)
    assert "@lapack_" in traced.lower().as_text()
    assert jax_compat.calls_lapack(traced.jaxpr.jaxpr)


def test_every_public_factorization_is_in_the_table():
    everything = dir(jax.lax.linalg)
    public = {x for x in everything if not x.startswith("_")}
    without_lapack = {"lu_pivots_to_permutation", "qdwh"}
    known = jax_compat._LAPACK | without_lapack
    names = {x for x in public if not x.endswith("_p") and not x[0].isupper()}
    assert names <= known, f"does XLA hand these to LAPACK: {names - known}?"


def test_programs_without_lapack():
    program = program_of(lambda x: jnp.sin(x) @ MATRIX, X)
    assert not jax_compat.calls_lapack(program)


# Traces, settings, options ----------------------------------------------------------------------


def test_inside_and_outside():
    inside = []

    def function(x):
        inside.append(jax_compat.is_outside())
        assert jax_compat.is_tracer(x)
        assert jax_compat.is_tracer(x + 1)
        with jax_compat.outside():
            assert not jax_compat.is_tracer(jnp.sin(1.0))
        return x

    jax.jit(function)(1.0)
    assert inside == [False]
    assert jax_compat.is_outside()


def test_own_traces():
    calls = []
    function = jax.jit(lambda x: calls.append(1) or x)
    function(1.0)
    function(1.0)
    with jax_compat.own_traces("one"):
        function(1.0)
    assert len(calls) == 2


def test_settings():
    assert jax_compat.has_double_precision()
    before = jax_compat.settings_of_programs()
    with jax.default_matmul_precision("float32"):
        assert jax_compat.settings_of_programs() != before
    with jax.disable_jit():
        assert not jax_compat.runs_programs_as_they_are()
    assert jax_compat.runs_programs_as_they_are()
    assert jax_compat.combines_as_numpy()
    with jax.numpy_rank_promotion("raise"):
        assert not jax_compat.combines_as_numpy()
    with jax.default_device(jax.devices("cpu")[0]):
        assert jax_compat.default_device() == jax.devices("cpu")[0]


def test_files_of_kept_programs(tmp_path):
    program = """
import pathlib, sys, jax
from hybridjax._core import jax_compat
folder = pathlib.Path(sys.argv[1])
jax_compat.keep_programs_in(folder)
jax_compat.silence_xla()
jax.jit(lambda x: x + 1.0)(2.0)
kept = set(jax_compat.kept_programs(folder))
assert kept and kept == set(folder.iterdir()), set(folder.iterdir())
"""
    run_python("-c", program, tmp_path)


def test_options_of_xla():
    names = {"xla_backend_optimization_level", "xla_cpu_use_fusion_emitters"}
    assert set(jax_compat.quick_options()) == names
    small = set(jax_compat.quick_options(small=True))
    assert small == names | {"xla_cpu_parallel_codegen_split_count"}
    assert set(jax_compat.loop_options()) == {"xla_cpu_use_fusion_emitters"}
    assert not jax_compat.is_known("xla_option_that_nobody_has", 1)


def test_annotations_of_numpy():
    array = np.typing.ArrayLike.__args__[0]
    assert jax_compat.is_numpy_annotation(getattr(array, "__origin__", array))
    assert not jax_compat.is_numpy_annotation(np.ndarray)


def test_a_branch_on_some_lanes_stays_a_branch_under_vmap():
    """equinox 0.11 to 0.13: `unvmap_any`."""

    def function(mask):
        some = jax_compat.some_of_all(mask)
        return jax.lax.cond(some, lambda: jnp.ones(()), lambda: jnp.zeros(()))

    masks = jnp.array([[False, True], [False, False]])
    program = jax.make_jaxpr(jax.vmap(function))(masks)
    assert "select_n" not in str(program)
    found_values = jax.vmap(function)(masks)
    assert found_values.tolist() == [1.0, 1.0]
    found = jax.vmap(function)(masks[1:])
    assert found.tolist() == [0.0]

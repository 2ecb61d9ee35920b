"""All that leans on parts of JAX and NumPy that may change between versions.

Each function answers a question ("which primitives does this program use?"), and its docstring says
what breaks if a later version gives another answer. `tests/_core/test_jax_compat.py` names the
version of JAX that all were tested with, and tries each of them. No other file of this package
imports `jax.core`, `jax.extend`, `jax.interpreters` or `jax.experimental`, reads JAX's
configuration, or contains the name of a primitive or an option of XLA.

After an update of JAX, run that test first. If programs are slower, look at `_FUNCTIONS` (functions
that are replaced) and at `is_known` (options that XLA has not); if threads wait for each other for
ever, at `_LAPACK`; if a smooth field is taken for one that jumps or has pulses, at `suddenness` and
the tables `_SMOOTH` to `_KINKS`, which need the name of each new primitive; if a change of a
function is not noticed, at `is_call`, `has_rule` and `is_hosted`.
"""

import contextlib
import functools as ft
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias, TypeGuard

import equinox.internal as eqxi
import jax
import jax.core
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.interpreters.partial_eval import dce_jaxpr


Program: TypeAlias = jex.Jaxpr
"""What JAX traces of a function: equations one after the other, with fields `invars`, `outvars`,
`constvars` and `eqns`."""

ClosedProgram: TypeAlias = jex.ClosedJaxpr
"""A program (`jaxpr`) with the values of its constants (`consts`)."""

Equation: TypeAlias = jex.JaxprEqn
"""A primitive, applied to variables and constants (`invars`), with results (`outvars`) and options
(`params`)."""


def lacks_transpose(error: AssertionError | ValueError) -> bool:
    """Return whether JAX says with this error that it cannot transpose a loop that ends by itself:
    by its text, or by an `AssertionError` without one inside of nested derivatives. A later version
    with other words shows its own error in place of ours."""
    if isinstance(error, AssertionError):
        return not str(error)
    return "reverse-mode" in str(error).lower()


# Programs ---------------------------------------------------------------------------------------


def is_closed(x: Any) -> TypeGuard[ClosedProgram]:
    """Return whether x is a program with its constants."""
    return isinstance(x, jex.ClosedJaxpr)


def is_program(x: Any) -> bool:
    """Return whether x is a program, with its constants or without."""
    return isinstance(x, jex.ClosedJaxpr | jex.Jaxpr)


def closed(x: Program | ClosedProgram) -> ClosedProgram:
    """A program with its constants (an empty list if it has none)."""
    return x if isinstance(x, jex.ClosedJaxpr) else jex.ClosedJaxpr(x, [])


def is_variable(x: Any) -> bool:
    """Return whether an argument of an equation is a variable, not a constant."""
    return isinstance(x, jex.Var)


def is_constant(x: Any) -> bool:
    """Return whether an argument of an equation is a constant, whose value is `x.val`."""
    return isinstance(x, jex.Literal)


def inner_programs(equation: Equation) -> list[Program]:
    """The programs among the options of an equation, or in tuples of these.

    (`jax.extend.core` has a function for it since JAX 0.10.1.) If JAX keeps programs elsewhere,
    what happens in them is not seen.
    """
    programs = []
    for option in equation.params.values():
        parts = option if isinstance(option, tuple) else (option,)
        programs += [closed(part).jaxpr for part in parts if is_program(part)]
    return programs


def primitives_of(program: Program) -> set[str]:
    """Names of the primitives that a program uses, also in its inner programs."""
    names = set()
    for equation in program.eqns:
        names.add(equation.primitive.name)
        for inner in inner_programs(equation):
            names |= primitives_of(inner)
    return names


def needed_part(
    program: Program, every_argument: bool = False
) -> tuple[Program, list[bool]]:
    """The part of a program on which its results depend, and which arguments belong to it.

    **Arguments:** `every_argument`: whether the part keeps the arguments that it does not need.
    """
    results = [True] * len(program.outvars)
    return dce_jaxpr(program, results, instantiate=every_argument)


def with_equations(program: Program, equations: Sequence[Equation]) -> Program:
    """A program with other equations for the same variables."""
    return program.replace(eqns=list(equations))


def with_program(whole: ClosedProgram, program: Program) -> ClosedProgram:
    """A program in place of another one, with the same constants."""
    return whole.replace(jaxpr=program)


def with_options(equation: Equation, options: dict[str, Any]) -> Equation:
    """An equation with other options for its primitive."""
    return equation.replace(params=options)


def in_place_of(old: Equation, new: Equation, arguments: Sequence[Any]) -> Equation:
    """`new` with the results of `old`, and with these arguments. Errors name the line of `old`."""
    return new.replace(
        invars=list(arguments), outvars=old.outvars, source_info=old.source_info
    )


def as_function(program: ClosedProgram) -> Callable[..., list]:
    """A program as a function of its arguments, which returns a list."""
    return jex.jaxpr_as_fun(program)


def lines_of(equation: Equation) -> list[tuple[str, int]]:
    """Files and lines of the calls that wrote an equation, the innermost first. If JAX records them
    elsewhere, messages name no line."""
    traceback = getattr(getattr(equation, "source_info", None), "traceback", None)
    frames = traceback.frames if traceback else ()
    return [(frame.file_name, frame.line_num) for frame in frames]


# What primitives do -----------------------------------------------------------------------------

# Primitives that call a program and do nothing more.
_CALLS = frozenset("jit pjit closed_call core_call remat checkpoint".split())
# Primitives that run inner programs, of which none has derivative rules of its own.
_OUTER = frozenset("jit pjit cond while scan custom_linear_solve".split())
# Functions that this package replaces, by the names of their primitives.
_FUNCTIONS = {
    "sin": "sin",
    "cos": "cos",
    "tan": "tan",
    "atan2": "arctan2",
    "atan": "arctan",
    "asin": "arcsin",
    "acos": "arccos",
    "cholesky": "cholesky",
    "triangular_solve": "triangular_solve",
    "lu": "lu",
    "custom_linear_solve": "solve",
    "dot_general": "product",
    "stack": "vector",
    "concatenate": "vector",
}
# Primitives that XLA hands to LAPACK on CPU, or a user to a library.
_LAPACK = frozenset(
    "cholesky cholesky_update eig eigh ffi_call geqp3 geqrf hessenberg householder_product lu "
    "ormqr qr schur svd symmetric_product triangular_solve tridiagonal tridiagonal_solve".split()
)
# Operations on real numbers without kinks, jumps and pulses.
_SMOOTH = frozenset(
    "add sub mul neg sin cos square add_any dot_general reduce_sum copy "
    "broadcast_in_dim concatenate convert_element_type expand_dims gather pad reshape slice "
    "dynamic_slice squeeze stack unstack split transpose".split()
)
# Operations that may have poles, that jump, and that have kinks.
_POLES = frozenset(("div", "integer_pow"))
_DECISIONS = frozenset(
    "sign floor ceil round rem atan2 gt lt ge le eq ne is_finite".split()
)
_KINKS = frozenset("max min abs clamp select_n cond".split())
# Operations that leave zero as it is.
_SAME_ZERO = frozenset(
    "broadcast_in_dim convert_element_type reshape neg squeeze".split()
)


def function_of(equation: Equation) -> str:
    """The function that an equation computes, if this package may replace it: "sin", "arctan2",
    "lu", "solve", "product", "vector" (numbers put together) ...; "" for others.

    If JAX renames a primitive, its function is not replaced, and is as slow as XLA makes it.
    """
    return _FUNCTIONS.get(equation.primitive.name, "")


def is_rounded(equation: Equation) -> bool:
    """Return whether the user chose the accuracy of a function (`accuracy=` of `jax.lax.sin`)."""
    return equation.params.get("accuracy") is not None


def form_of_factors(equation: Equation) -> tuple[tuple[str, bool], ...]:
    """Which triangle a factorization takes, and how: options of our functions for it."""
    names = {"left_side", "lower", "transpose_a", "unit_diagonal"}
    return tuple((x, equation.params[x]) for x in sorted(names & set(equation.params)))


def solved_by(equation: Equation) -> tuple[Any, Any, list, Equation] | None:
    """The matrix, the right side, the constants of the solution (factors) and the product with
    the matrix, of an equation that solves a linear system; None if it has another form.

    If JAX keeps them elsewhere, `jnp.linalg.solve` is not replaced, and is slower.
    """
    lengths = equation.params["const_lengths"]
    if lengths.matvec != 1:
        return None
    matrix, *_, right = equation.invars
    constants = equation.invars[lengths.matvec + lengths.vecmat :][: lengths.solve]
    times = equation.params["jaxprs"].matvec
    product = times.jaxpr.eqns[0]
    if product.invars != times.jaxpr.invars:
        return None
    return matrix, right, constants, product


def is_outer(equation: Equation) -> bool:
    """Return whether functions in the inner programs of an equation may be replaced. (Equations
    with derivative rules of their own are left as they are.)"""
    return equation.primitive.name in _OUTER


def is_call(equation: Equation) -> bool:
    """Return whether an equation calls a program, and does nothing more. If JAX renames such a
    primitive, `jax.jit` in a user's function counts as an operation of its own."""
    return equation.primitive.name in _CALLS


def has_rule(equation: Equation) -> bool:
    """Return whether an equation calls a function with derivatives by `custom_jvp`. If not seen, a
    change in such a rule is not noticed."""
    return equation.primitive.name.startswith("custom_jvp_call")


def is_hosted(equation: Equation) -> bool:
    """Return whether an equation calls functions of Python: those of `custom_vjp`, and callbacks.
    If not seen, a change in such a function is not noticed."""
    name = equation.primitive.name
    return name.startswith("custom_vjp_call") or "callback" in equation.params


def calls_lapack(program: Program) -> bool:
    """Return whether a program may call LAPACK, also in its inner programs.

    Two programs with such calls, run at once, can wait for each other for ever. Therefore the
    answer follows from the primitives that were traced, and not from the text that XLA makes of
    them. If JAX adds a primitive for LAPACK under a new name, the test of this function fails.
    """
    return not _LAPACK.isdisjoint(primitives_of(program))


def works_on_bits(equation: Equation) -> bool:
    """Return whether an equation shifts bits or takes integer powers, as Python does not: it needs
    exponents that are small and not negative."""
    name = equation.primitive.name
    return name.startswith("shift") or name == "pow"


def gives_zero(equation: Equation, zeros: Sequence[bool]) -> bool:
    """Return whether the result of an equation is zero, given which arguments are. If JAX renames
    a product, a field with the term `0 * t` counts as one that depends on time."""
    name = equation.primitive.name
    if name == "mul":
        return any(zeros)
    return name in _SAME_ZERO and zeros[0]


def solves_scalars_only(equation: Equation) -> bool:
    """Return whether an equation is the division of our `solve_positive`, which decides only
    whether the solution is NaN."""
    return equation.params.get("name") == "solve_positive"


def suddenness(equation: Equation, moves: Sequence[bool]) -> list[str]:
    """How an equation may jump or have pulses if some of its arguments move: by a "pole", a
    "decision" (it jumps), a "kink", a "power" beyond squares (in a denominator it makes pulses), or
    "otherwise", which also stands for primitives with names that JAX introduces later."""
    name = equation.primitive.name
    kinds = []
    if not _is_smooth(equation, moves):
        if name in _POLES:
            kinds.append("pole")
        elif name in _DECISIONS:
            kinds.append("decision")
        elif name in _KINKS:
            kinds.append("kink")
        else:
            kinds.append("otherwise")
    if abs(equation.params.get("y", 0)) > 2:
        kinds.append("power")
    return kinds


def _is_smooth(equation: Equation, moves: Sequence[bool]) -> bool:
    match equation.primitive.name:
        case "div":
            return not moves[1]
        case "select_n":
            return not moves[0]
        case "integer_pow":
            return equation.params["y"] > 0
        case "scatter-add":
            return not moves[1]
        case name:
            # (JAX 0.11 leaves calls without results in a program.)
            results: list[Any] = equation.outvars
            real = all(jnp.issubdtype(x.aval.dtype, jnp.inexact) for x in results)
            return is_call(equation) or (name in _SMOOTH and real)


# Traces -----------------------------------------------------------------------------------------


def is_tracer(x: Any) -> bool:
    """Return whether JAX traces x, so that its value is not known."""
    return isinstance(x, jax.core.Tracer)


def outside() -> contextlib.AbstractContextManager:
    """A context outside of all transformations of JAX: what is computed there has values, also
    while a program is traced. If JAX drops it, nothing runs on the host inside of programs."""
    return jax.core.eval_context()


with outside():
    _OUTSIDE = jex.get_opaque_trace_state()


def is_outside() -> bool:
    """Return whether no transformation of JAX is at work. (If this is wrongly false, an operation
    tells, see `executor.is_inside_program`, which takes longer.)"""
    return jex.get_opaque_trace_state() == _OUTSIDE


def own_traces(words: str) -> contextlib.AbstractContextManager:
    """A context in which JAX uses no trace from outside: it remembers traces by the words that
    belong to their operations, too. If it did not, changes of a notebook's functions would not be
    noticed."""
    context: Any = set_xla_metadata(hybridjax=words)
    return context


# JAX's configuration ----------------------------------------------------------------------------


def _setting(name: str) -> Any:
    """A setting that JAX does not declare to type checkers. If JAX renames it, this raises
    `AttributeError` with its name."""
    return getattr(jax.config, name)


def use_double_precision() -> None:
    """Switch JAX to 64-bit floating point for this process."""
    jax.config.update("jax_enable_x64", True)


def has_double_precision() -> bool:
    """Return whether JAX is switched to 64-bit floating point."""
    return bool(_setting("jax_enable_x64"))


def default_device() -> Any:
    """The device of `jax.default_device`: a device, the name of a platform, or None."""
    return _setting("jax_default_device")


def settings_of_programs() -> tuple:
    """Values of JAX's settings by which the same function becomes another program. If JAX gets
    another such setting, changing it takes effect in a new process only."""
    return (
        _setting("jax_enable_x64"),
        _setting("jax_default_matmul_precision"),
        _setting("jax_numpy_dtype_promotion"),
    )


def runs_programs_as_they_are() -> bool:
    """Return whether JAX compiles programs, and does not look for NaN or infinity in results."""
    return not (
        _setting("jax_disable_jit")
        or _setting("jax_debug_nans")
        or _setting("jax_debug_infs")
    )


def combines_as_numpy() -> bool:
    """Return whether JAX combines arrays of different ranks and types as NumPy does."""
    return (
        _setting("jax_numpy_rank_promotion") == "allow"
        and _setting("jax_numpy_dtype_promotion") == "standard"
    )


def keep_programs_in(folder: pathlib.Path) -> None:
    """Have JAX keep all compiled programs in a folder, also the smallest: those of users' functions
    are the first that a process needs."""
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def kept_programs(folder: pathlib.Path) -> Iterator[pathlib.Path]:
    """The files of a folder of programs that JAX reads or writes (`...-cache`, `...-atime`). If JAX
    names its files differently, files of other users in the folder are not refused."""
    yield from folder.glob("*-[ac]*e")


def silence_xla() -> None:
    """Have XLA print nothing.

    It prints two errors, a page each, for each program that it loads on a processor with AVX-512.
    Its only switch is the level of all its messages, which JAX ties to that of its own. If JAX
    separates them, the errors are printed.
    """
    level = _setting("jax_logging_level")
    jax.config.update("jax_logging_level", "CRITICAL")
    jax.config.update("jax_logging_level", level)


# Options of XLA ---------------------------------------------------------------------------------

# XLA emits a loop on CPU as one kernel if an iteration touches fewer bytes than this; its own value
# is 1024.
LOOP_KERNELS = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000000"
)


@ft.cache
def quick_options(small: bool = False) -> dict[str, Any]:
    """XLA's options for quick compilation, also of a `small` program: no optimization passes of
    LLVM, and the older of XLA's two code generators, which take a third of the time. Options that
    this version of XLA does not have are left out: programs compile longer."""
    options: dict[str, Any] = {
        "xla_backend_optimization_level": 0,
        "xla_cpu_use_fusion_emitters": False,
    }
    if small:
        # XLA divides a program among its threads: dividing a small one takes a fifth longer.
        options["xla_cpu_parallel_codegen_split_count"] = 1
    return _known(options)


@ft.cache
def loop_options() -> dict[str, Any]:
    """XLA's options for programs that run through loops many times. (The older code generator
    compiles in half of the time; without optimization loops take ten times as long.)"""
    return _known({"xla_cpu_use_fusion_emitters": False})


def _known(options: dict[str, Any]) -> dict[str, Any]:
    """Those options that this version of XLA has."""
    return {name: value for name, value in options.items() if is_known(name, value)}


def is_known(name: str, value: Any) -> bool:
    """Return whether this version of XLA has an option."""
    try:
        jax.jit(lambda: 0, compiler_options={name: value})()
    except Exception:  # its type depends on the version
        return False
    return True


def loops_are_kernels() -> bool:
    """Return whether XLA compiles a loop above its own limit into one function of machine code. If
    XLA calls that function otherwise, `enable_loop_kernels` refuses to work."""

    def loop(x, count):
        return jax.lax.fori_loop(0, count, lambda _, x: x * x[0], x)

    program = jax.jit(loop).lower(jnp.ones(1000), 9).compile()
    return "xla_cpu_small_call" in str(program.as_text())


# Types of numbers -------------------------------------------------------------------------------


def is_numpy_annotation(cls: type) -> bool:
    """Return whether a class stands for arrays in NumPy's annotations (`numpy.typing.NDArray`). If
    NumPy moves it, an annotation that is refused in the tests is not refused there."""
    return cls.__module__.startswith("numpy._typing")


def bits_of(x: Any) -> int | None:
    """The bits of a variable's floating-point numbers; None for other numbers."""
    dtype = getattr(x.aval, "dtype", None)
    if dtype is None or not jnp.issubdtype(dtype, jnp.floating):
        return None
    return jnp.finfo(np.dtype(dtype)).bits


def some_of_all(mask: jax.Array) -> jax.Array:
    """Whether a mask holds anywhere, in all that `jax.vmap` maps: a predicate that stays a single
    one, so that a branch stays a branch. (If equinox moves its function, `cond` with `mask.any()`
    does the same, but computes both sides under `vmap`.)"""
    return eqxi.unvmap_any(mask)

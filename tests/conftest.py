import contextlib
import gc
import importlib.metadata
import os
import pathlib
import re
import subprocess
import sys


# Said before NumPy and XLA are loaded, here and in the workers of pytest-xdist: threads of BLAS
# that wait for each other cost ten times the work, and XLA reports each cached program.
os.environ.update(OPENBLAS_NUM_THREADS="1", TF_CPP_MIN_LOG_LEVEL="3")
if "PYTEST_XDIST_WORKER" not in os.environ:
    # Compiled programs are kept between runs, since compiling is most of the time of a test.
    _programs = pathlib.Path(__file__).parents[1] / ".pytest_cache" / "programs"
    os.environ.setdefault("HYBRIDJAX_CACHE", str(_programs))
    # Most of the time of a test is that of compiling what it runs once. (XLA ends the process where
    # it does not know an option, so other processes try them, once for each version.)
    _answer = _programs.with_name(f"accepted-{importlib.metadata.version('jaxlib')}")
    if not _answer.exists():
        _try = [sys.executable, "-c", "import jax; jax.devices()"]
        _quick = (
            "--xla_backend_optimization_level=0",
            "--xla_cpu_use_fusion_emitters=false",
        )
        _accepted = [
            option
            for option in _quick
            if not subprocess.run(
                _try, env={**os.environ, "XLA_FLAGS": option}, stderr=subprocess.DEVNULL
            ).returncode
        ]
        _answer.parent.mkdir(exist_ok=True)
        _answer.write_text(" ".join(_accepted))
    os.environ["XLA_FLAGS"] = f"{_answer.read_text()} {os.environ.get('XLA_FLAGS', '')}"

import hypothesis
import jax
import jaxtyping
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core import compilation
from hybridjax._core.execution import libraries
from hybridjax.orbits import same_call


# Files whose fast tests cover each capability once, for `-m core`.
CORE = (
    "test_layers",
    "test_release",
    "linear/test_ldtp",
    "linear/test_htf",
    "engine/test_chain",
    "systems/test_system",
    "orbits/test_cycle",
    "sections/test_linearize",
    "experiments/test_design",
    "experiments/test_steady",
    "identify/test_nonparametric",
    "identify/test_structured",
    "identify/test_rational",
    "recordings/test_recording",
    "designs/test_limits",
    "fitting/test_parameters",
    "_core/test_boundary",
    "plot/test_plots",
    "test_io",
)


def pytest_collection_modifyitems(items):
    for item in items:
        name = item.nodeid.removeprefix("tests/").partition(".py")[0]
        if name in CORE and not item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.core)


def pytest_configure(config):
    """Files stay in their order: by default one with a single long test is the last to start."""
    config.option.loadscopereorder = False


def pytest_xdist_auto_num_workers(config):
    """A single process for a part of the tests: starting others takes longer than the tests."""
    if config.args != config.getini("testpaths"):
        config.option.dist = "no"
        return 0
    return None


# Tracing makes a million objects that live until a program is compiled: by default the collector
# visits all of them many times, a twentieth of the time of the tests.
gc.freeze()
gc.set_threshold(100_000, 20, 20)

# (A plugin of pytest may have loaded NumPy before this file.)
for library in libraries():
    library.set(1)
hj.enable_x64()
hj.scale.enable_compilation_cache()  # of this run: what one worker has compiled the others need not
hypothesis.settings.register_profile(
    "untimed", hypothesis.settings.default, deadline=None
)
hypothesis.settings.load_profile("untimed")

DATA = pathlib.Path(__file__).parent / "data"

APEX = hj.Crossing("vM", "falling")
ISOCHRONS = hj.ClockPhase(32, anchor=APEX)
KINEMATIC = hj.KinematicPhase(32, "yM", "vM", (1.9, 0.0), (0.3, 1.9), anchor=APEX)
OUTPUTS = ("yM", "vM")


@contextlib.contextmanager
def unchecked_host():
    """On the host, checks of types take ten times as long as what they check. The same code is
    checked where JAX traces it."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        with np.errstate(all="ignore"):
            yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


compilation.at_ease = unchecked_host
# The tests of a process find many cycles of one kind, of which few take longer on the host than
# compiling would.
compilation.WORTH_COMPILING = 15.0


# Programs that a worker keeps, of some 5 MB each. Doubled: twice the memory.
_KEPT = 200
_compiled = []


def _count(event, duration, **_):
    if "backend_compile" in event:
        _compiled.append(event)


jax.monitoring.register_event_duration_secs_listener(_count)


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Of earlier files, where there are many. (They stay on disk.)"""
    yield
    if len(_compiled) > _KEPT:
        _compiled.clear()
        jax.clear_caches()


@pytest.fixture(autouse=True)
def forget_cycles():
    """Of other tests: each test searches."""
    same_call._found.clear()


@pytest.fixture(autouse=True)
def figures_are_closed():
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@contextlib.contextmanager
def compiled():
    """The names of all that is compiled in this context, where functions of few lanes stay on the
    host: by default the seconds that earlier tests have spent there decide."""
    names = set()
    patience = compilation.WORTH_COMPILING

    def listen(event, *_, fun_name="", **__):
        if "backend_compile" in event:
            names.add(re.sub(r"^jit\(|_[0-9a-f]{32}|\)$", "", fun_name))

    compilation.WORTH_COMPILING = np.inf
    same_call._found.clear()
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield names
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
        compilation.WORTH_COMPILING = patience


@contextlib.contextmanager
def no_compilation(after):
    """A context in which nothing may be compiled, once `after()` has run."""
    with compiled():
        after()
    with compiled() as names:
        yield
    assert not names


@pytest.fixture(scope="session")
def reference():
    """Independent high-precision results for the paper's hopper; see tests/data/README.md."""

    def load(name):
        with np.load(DATA / f"{name}.npz") as file:
            return dict(file)

    return load


@pytest.fixture(scope="session")
def hopper_cycle():
    return hj.find_limit_cycle(hj.models.VerticalHopper())


@pytest.fixture(scope="session")
def lossy_cycle():
    """A hopper that loses a fifth of its speed at touchdown: its saltation is not trivial."""
    return hj.find_limit_cycle(hj.models.VerticalHopper(retention=0.8))


@pytest.fixture(scope="session")
def placed_isochrons(hopper_cycle):
    return hj.sections.place_sections(hopper_cycle, ISOCHRONS)


@pytest.fixture(scope="session")
def placed_kinematic(hopper_cycle):
    return hj.sections.place_sections(hopper_cycle, KINEMATIC)


@pytest.fixture(scope="session")
def isochron_ldtp(hopper_cycle, placed_isochrons):
    return hj.linearize(hopper_cycle, placed_isochrons, OUTPUTS)


@pytest.fixture(scope="session")
def kinematic_ldtp(hopper_cycle, placed_kinematic):
    return hj.linearize(hopper_cycle, placed_kinematic, OUTPUTS)


@pytest.fixture(scope="session")
def vanderpol_cycle():
    system = hj.models.VanDerPol(mu=1.0)
    section = hj.Crossing("v", "falling")
    return hj.find_limit_cycle(system, section=section)

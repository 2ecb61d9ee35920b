"""Plants: closed forms, the paper's hopper against its exact model, and plants that fail."""

import math
import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj

from .hopper import Hopper
from .toys import Circle, Troubled


ANGLE = hj.KinematicPhase(8, "x", "y", center=(0.0, 0.0), scale=(1.0, 1.0))
APEX = 0.7233423518  # s
ELLIPSE = {"center": (1.9, 0.0), "scale": (0.3, 1.9)}
SECTIONS = {
    "isochron": hj.ClockPhase(16, anchor=APEX),
    "kinematic": hj.KinematicPhase(16, "yM", "vM", **ELLIPSE),
}
DESIGN = hj.multisine(16, periods=16, amplitude=0.002)


@pytest.fixture(scope="module")
def circle():
    return hj.plants.find_cycle(Circle(), ANGLE, ("x", "y"), cycles=20)


MULTIPLIER = math.exp(-0.4 * math.pi)  # of the circle's radius


def test_a_plant_in_closed_form(circle):
    assert_allclose(circle.period, 2 * math.pi, rtol=0, atol=1e-9)
    angle = 2 * math.pi * np.arange(8) / 8
    x = np.cos(angle)
    y = np.sin(angle)
    directions = np.stack([x, y], axis=1)
    assert_allclose(circle.cycle_outputs, directions, rtol=0, atol=1e-9)


def test_returns_of_a_plant_have_the_multiplier_of_its_closed_form(circle):
    returns = circle.perturbed_returns()
    assert returns.contains(MULTIPLIER).all()
    assert_allclose(returns.multipliers, [MULTIPLIER], rtol=0, atol=1e-9)
    assert returns.bound < 1e-6
    alone = circle.perturbed_returns("x")
    assert len(alone.coordinates) == 1


def test_a_push_moves_a_plant_as_its_closed_form(circle):
    """Held over one eighth of a turn, it moves the radius by push / rate (1 - exp(-rate T / 8))."""
    push = 0.1
    rate = 0.2
    u = np.zeros((1, 16, 1))
    u[0, 3] = push
    data = circle.run_experiments(u, discard=0, processes=0)
    before = data.y[0, :4]
    after = data.y[0, 4:]
    assert_allclose(before, 0, rtol=0, atol=1e-8)
    angle = 2 * math.pi * np.arange(4, 16) / 8
    x = after[:, 0]
    y = after[:, 1]
    radius = x * np.cos(angle) + y * np.sin(angle)
    decay = math.exp(-rate * math.tau / 8)
    start = push / rate * (1 - decay)
    expected = start * decay ** np.arange(12)
    assert_allclose(radius, expected, rtol=0, atol=1e-8)
    assert data.outputs[0].unit == "m"
    assert data.inputs[0].unit == "m/s"


def test_sections_at_events():
    """Crossings of signals, at angles 0.2 and pi - 0.2: exact places, and the multiplier."""
    level = math.sin(0.2)
    rising = hj.Crossing("y", "rising", level)
    falling = hj.Crossing("y", "falling", level)
    cycle = hj.plants.find_cycle(Circle(), [rising, falling], ("x", "y"), cycles=20)
    assert_allclose(cycle.period, math.tau, rtol=0, atol=1e-9)
    right = math.cos(0.2)
    places = [[right, level], [-right, level]]
    assert_allclose(cycle.cycle_outputs, places, rtol=0, atol=1e-8)
    returns = cycle.perturbed_returns()
    assert_allclose(returns.multipliers, [MULTIPLIER], rtol=0, atol=1e-6)


def test_a_motion_is_recorded_up_to_a_fall(circle):
    def picture(z):
        point = (z["x"], z["y"], 0.1)
        return hj.systems.Drawing(circles={"point": point})

    motion = circle.trajectory(picture)
    t, x = motion("x")
    error = abs(motion.t[-1] - 2 * math.pi)
    assert error < 1e-8
    expected_cosine = np.cos(t)
    error = np.abs(x - expected_cosine).max()
    assert error < 1e-3
    expected_x = np.cos(motion.t)
    error = np.abs(motion.after[:, 0] - expected_x).max()
    assert error < 1e-9
    film = hj.plot.animate(motion, "x", "y")
    assert len(film.times) > 4

    class Falls(Circle):
        def step(self, u, duration):
            if u[0] > 1:
                raise (
                    hj.errors.ComputationError("fell")
                    if u[0] == 2
                    else ZeroDivisionError
                )
            return super().step(u, duration)

    cycle = hj.plants.find_cycle(Falls(), ANGLE, "x", cycles=20)
    pushes = [[0.0], [0.0], [2.0], [0.0]]
    fall = cycle.trajectory(picture, pushes)
    assert fall.result == hj.errors.Result.PLANT_STOPPED
    error = abs(fall.t[-1] - math.pi / 2)
    assert error < 1e-8
    with pytest.raises(ZeroDivisionError):  # a mistake in the plant is no fall
        cycle.trajectory(u=[[3.0]])


class Travelling(Circle):
    """A circle that also rolls: the distance grows by 2 pi in each turn, and by the radius."""

    states = ("x", "y", "distance")

    def reset(self, seed):
        self.distance = 0.0
        return super().reset(seed)

    def get_state(self):
        return (*self.q, self.distance)

    def set_state(self, q):
        if len(q) > 2:
            self.distance = float(q[2])
        return super().set_state(q[:2]) | {"distance": self.distance}

    def step(self, u, duration):
        self.distance += duration * math.hypot(*self.q)
        return super().step(u, duration)


def test_coordinates_that_travel_are_found_and_the_settled_state_stays():
    cycle = hj.plants.find_cycle(Travelling(), ANGLE, "x", cycles=20)
    returns = cycle.perturbed_returns()
    assert returns.travelling == ("distance",)
    assert returns.coordinates == ("x", "y")
    assert "they travel: distance" in repr(returns)
    assert_allclose(returns.multipliers, [MULTIPLIER], rtol=0, atol=1e-7)
    # Perturbed on demand, it has the multiplier 1.
    chosen = cycle.perturbed_returns(("x", "y", "distance"))
    assert_allclose(chosen.multipliers, [1, MULTIPLIER], rtol=0, atol=1e-7)
    assert chosen.residual < 1e-9


class Stairs:
    """A value v that an event changes once in each period: v becomes -(a v + b t) at the time t = c
    + d v, and changes its sign at the end of the period. The simulator detects the event at the end
    of a time step, so that the return map is a staircase of mean slope a + b d."""

    inputs = ("u",)
    period = 1.0
    states = ("time", "v", "fired")

    def __init__(self, a, b, c, d, dt):
        self.numbers = a, b, c, d
        self.dt = dt

    def reset(self, seed):
        return self.set_state((0.0, 0.1, 0.0))

    def get_state(self):
        return (self.t, self.v, self.fired)

    def set_state(self, q):
        self.t, self.v, self.fired = map(float, q)
        return {"v": self.v}

    def step(self, u, duration):
        a, b, c, d = self.numbers
        self.t += duration
        self.v += duration * u[0]
        time = (self.t + 1e-9) % 1.0
        if self.fired and time < c / 2:
            self.v = -self.v
            self.fired = 0.0
        elif not self.fired and time >= c + d * self.v:
            self.v = -(a * self.v + b * time)
            self.fired = 1.0
        return {"v": self.v}


@pytest.mark.slow
def test_errors_contain_the_stairs_of_time_steps():
    """The mean slope lies in 95 % of the regions; the slope of one step does not, where the stairs
    are resolved."""
    rng = np.random.default_rng(0)
    held = []
    flat = []
    for _ in range(20):
        a = rng.uniform(0.2, 0.5)
        b = rng.uniform(0.3, 0.5)
        c = rng.uniform(0.25, 0.4)
        d = rng.uniform(0.3, 0.5)
        time_step = float(1 / rng.integers(100, 300))
        plant = Stairs(a, b, c, d, time_step)
        sections = hj.ClockPhase(2)
        cycle = hj.plants.find_cycle(plant, sections, "v", cycles=40)
        returns = cycle.perturbed_returns("v")
        true = a + b * d
        held.append(bool(returns.contains(true).all()))
        flat.append(bool(returns.contains(a).all()))
    # (Fewer than 17 once in 70 times, if the regions are right.)
    assert sum(held) >= 17
    assert sum(flat) < 10


class FineStairs(Stairs):
    """The same, whose simulator divides each of its steps into five."""

    def step(self, u, duration):
        fine = self.dt / 5
        count = int(duration / fine + 1e-9)
        for _ in range(count):
            super().step(u, fine)
        return super().step(u, duration - count * fine)


@pytest.mark.slow
def test_errors_contain_stairs_of_steps_that_a_plant_divides():
    """Phases of the grid that follow the sizes of the steps would look like curvature: the errors
    are then a third of the true ones."""
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(16):
        a = rng.uniform(0.2, 0.5)
        b = rng.uniform(0.3, 0.5)
        c = rng.uniform(0.25, 0.4)
        d = rng.uniform(0.3, 0.5)
        time_step = float(1 / rng.integers(20, 60))
        plant = FineStairs(a, b, c, d, time_step)
        sections = hj.ClockPhase(2)
        cycle = hj.plants.find_cycle(plant, sections, "v", cycles=40)
        returns = cycle.perturbed_returns("v")
        off = returns.multipliers[0] - (a + b * d)
        ratios.append(abs(off) / returns.standard_errors[0])
    # (The rms of 16 numbers of Student's distribution with 21 degrees of freedom.)
    rms = np.sqrt(np.mean(np.square(ratios)))
    assert 0.5 < rms < 1.5


class Rounded(Circle):
    """A circle with another coordinate that is at rest, but for rounding errors."""

    states = ("x", "y", "side")

    def reset(self, seed):
        self.side = 0.0
        return super().reset(seed)

    def get_state(self):
        return (*self.q, self.side)

    def set_state(self, q):
        if len(q) > 2:
            self.side = float(q[2])
        return super().set_state(q[:2]) | {"side": self.side}

    def step(self, u, duration):
        rounding = 4e-16 * math.sin(1e4 * self.q[0])
        decay = math.exp(-0.1 * duration)
        self.side = (1.0 + self.side * decay + rounding) - 1.0
        return super().step(u, duration)


def test_a_coordinate_of_rounding_errors_is_at_rest():
    """Its range is no size: it is neither off the cycle, nor noise."""
    cycle = hj.plants.find_cycle(Rounded(), ANGLE, "x", cycles=40)
    returns = cycle.perturbed_returns()
    slow = math.exp(-0.2 * math.pi)
    assert_allclose(returns.multipliers, [slow, MULTIPLIER], rtol=0, atol=1e-6)
    assert not returns.findings


@pytest.mark.parametrize(("size", "cause"), [(1e-6, "stairs"), (0.1, None)])
def test_inputs_that_stay_on_one_stair_are_named(size, cause):
    plant = Stairs(0.4, 0.4, 0.3, 0.4, 0.005)
    sections = hj.ClockPhase(2)
    cycle = hj.plants.find_cycle(plant, sections, "v", cycles=40)
    rng = np.random.default_rng(0)
    u = size * rng.normal(size=(4, 60, 1))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        data = cycle.run_experiments(u, processes=0)
    causes = [finding.cause for finding in data.findings]
    assert causes == ([cause] if cause else [])
    assert len(said) == len(causes)


def test_inputs_beyond_the_linear_range_are_named():
    """A push acts by its value and its square."""

    class Curved(Circle):
        def step(self, u, duration):
            square = 0.1 * u[0] ** 2
            return super().step([u[0] + square], duration)

    cycle = hj.plants.find_cycle(Curved(), ANGLE, "x", cycles=20)
    rng = np.random.default_rng(0)
    u = rng.normal(size=(4, 32, 1))
    small = cycle.run_experiments(1e-3 * u, discard=0, processes=0)
    assert not small.findings
    with pytest.warns(hj.errors.FindingWarning, match="not linear"):
        data = cycle.run_experiments(0.1 * u, discard=0, processes=0)
    assert [finding.cause for finding in data.findings] == ["amplitude"]
    assert "Amplitude" in repr(data)


def test_an_unstable_cycle_is_found_from_a_guess():
    class Unstable(Circle):
        rate = -0.2

    cycle = hj.plants.find_cycle(Unstable(), ANGLE, "x", guess=(1.02, 0.0))
    error = abs(cycle.period - 2 * math.pi)
    assert error < 1e-6
    error = abs(cycle.cycle_outputs[0, 0] - 1)
    assert error < 1e-8
    returns = cycle.perturbed_returns()
    multiplier = math.exp(0.4 * math.pi)
    assert returns.contains(multiplier).all()
    assert len(returns.multipliers) == 1


@pytest.mark.slow
def test_failures_are_named_and_the_others_go_on():
    cycle = hj.plants.find_cycle(Troubled(), ANGLE, "x", cycles=20)
    data = cycle.run_experiments(
        np.zeros((9, 24, 1)), discard=0, processes=2, limit=15.0
    )
    expected_ok = [True] + 7 * [False] + [True]
    assert data.ok.tolist() == expected_ok
    causes = data.simulated.causes
    expected = (
        "",
        "the plant raised ValueError: the hip broke",
        "no answer within the limit of 15 s",
        "y became nan",
        "signals changed from ('x', 'y') to ('x', 'z')",
        "the plant is not deterministic after `reset(seed)`",
        "the process ended with code 3",
        "was not reached within",
        "",
    )
    named = [x in cause for x, cause in zip(expected, causes, strict=True)]
    assert named == [True] * 9
    stopped = 7 * [hj.errors.Result.PLANT_STOPPED]
    assert (data.result[1:8] == stopped).all()
    assert np.isfinite(data.y[[0, 8]]).all()
    later = data.y[1, data.failed_at[1] :]
    assert np.isnan(later).all()
    assert "#1: section" in data.summary(9)
    assert "the hip broke" in data.summary(9)


def test_a_store_continues(circle, tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    u = 0.01 * rng.standard_normal((10, 16, 1))
    whole = circle.run_experiments(u, discard=0, processes=0)
    experiment = type(circle.drive)
    seeds = []
    run = experiment.run

    def interrupted(self, seed, u):
        seeds.append(seed)
        if len(seeds) == 9:
            raise KeyboardInterrupt
        return run(self, seed, u)

    monkeypatch.setattr(experiment, "run", interrupted)
    options = {"discard": 0, "processes": 0, "store": tmp_path / "store.sqlite"}
    with pytest.raises(KeyboardInterrupt):
        circle.run_experiments(u, **options)
    data = circle.run_experiments(u, **options)
    # (The last two have half of the first input and none, which test the size of the inputs.)
    expected = [*range(1, 10), 9, 10, 1, 1]
    assert seeds == expected
    assert np.array_equal(data.y, whole.y)
    assert data.simulated.causes == 10 * ("",)
    assert not np.array_equal(
        circle.run_experiments(2 * u[:1], **options).y, data.y[:1]
    )
    monkeypatch.setattr(circle.drive.plant, "rate", 0.4)  # around the same cycle
    other = circle.run_experiments(u, **options)
    apart = np.abs(other.y - data.y)
    assert apart.max() > 1e-3
    hj.save(tmp_path / "data.npz", data)
    stored = hj.load(tmp_path / "data.npz")
    assert np.array_equal(stored.y, data.y)


def test_what_does_not_fit_is_refused(circle):
    for sections, message in (
        (hj.ClockPhase(8), "use KinematicPhase"),
        (hj.KinematicPhase(8, "x", "z"), "no signal 'z'"),
        (hj.Crossing("z", "falling"), "no signal 'z'"),
        (hj.Crossing(lambda t, q: q[0], "falling"), "Crossings of signals by name"),
        (
            hj.KinematicPhase(8, "x", "y", anchor=hj.Crossing("x", "falling")),
            "use KinematicPhase",
        ),
    ):
        with pytest.raises(hj.errors.DefinitionError, match=message):
            hj.plants.find_cycle(Circle(), sections, "x")
    with pytest.raises(hj.errors.DefinitionError, match="no output 'z'"):
        hj.plants.find_cycle(Circle(), hj.KinematicPhase(8, "x", "y"), "z")

    class Slow(Circle):
        rate = 0.01

    with pytest.raises(hj.errors.ComputationError, match="has not settled"):
        hj.plants.find_cycle(Slow(), ANGLE, "x", cycles=8)

    class Forgetful(Circle):
        def step(self, u, duration):  # (`get_state` lacks the number of steps)
            wind = 0.05 * math.sin(0.03 * self.steps)
            return super().step([wind], duration)

    with pytest.raises(hj.errors.DefinitionError, match="does not continue as before"):
        hj.plants.find_cycle(Forgetful(), ANGLE, "x", cycles=20)
    with pytest.raises(hj.errors.DefinitionError, match="as `get_state` returns it"):
        hj.plants.find_cycle(Circle(), ANGLE, "x", guess=(1.0, 0.0, 0.0))
    with pytest.raises(hj.errors.DefinitionError, match="no coordinate 'z'"):
        circle.perturbed_returns("z")


@pytest.fixture(scope="module")
def hopper():
    return hj.find_limit_cycle(hj.models.VerticalHopper())


def test_a_lasting_push_leads_to_another_cycle():
    """The radius tends to 1.05 by the multiplier."""
    level = math.sin(0.2)
    section = hj.Crossing("y", "rising", level)
    cycle = hj.plants.find_cycle(Circle(), section, "x", cycles=20)
    assert cycle.perturbed_returns().contains(MULTIPLIER).all()
    push = np.full((1, 8, 1), 0.01)
    data = cycle.run_experiments(push, discard=0, processes=0)
    assert data.ok.all()
    on_circle = math.sqrt(1 - level**2)
    x = on_circle + data.y[0, :, 0]
    radius = np.hypot(x, level)
    expected = 1.05 - 0.05 * MULTIPLIER ** np.arange(8)
    assert_allclose(radius, expected, rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    "family", ["isochron", pytest.param("kinematic", marks=pytest.mark.slow)]
)
@pytest.mark.slow
def test_the_hopper_is_that_of_the_equations(hopper, family):
    """Perturbed returns against the exact multipliers; records against exact experiments."""
    outputs = ("yM", "vM")
    cycle = hj.plants.find_cycle(Hopper(), SECTIONS[family], outputs)
    returns = cycle.perturbed_returns()
    assert len(returns.multipliers) == 2
    assert returns.compare(hopper.multipliers).max_error < 1e-7
    assert returns.contains(hopper.multipliers).all()

    rng = np.random.default_rng(0)
    u = 0.02 * rng.standard_normal((2, 64, 1))
    data = cycle.run_experiments(u, discard=0, processes=0)
    exact = hj.run_experiments(hopper, SECTIONS[family], u, outputs, discard=0)
    assert_allclose(data.cycle_outputs, exact.cycle_outputs, rtol=0, atol=1e-9)
    assert_allclose(data.y, exact.y, rtol=0, atol=1e-8)
    assert np.abs(data.y).max() > 1e-3, "the input moves the hopper"
    assert data.simulated.late.max() < 1e-9
    if family == "kinematic":
        estimate = hj.estimate_htf(cycle.run_experiments(DESIGN, discard=40))
        fit = hj.fit_multipliers(estimate, order=2)
        assert fit.contains(hopper.multipliers).all()

"""Other questions, the hopper's spring and damper, and deviations from the cycle limited.

Three rows of `designs.py`. HTFs of the hopper itself have white noise, 20 dB below the outputs in
the usual design; their variances are known.
"""

import time

import equinox as eqx
import numpy as np
from second_order import OUTPUTS

import hybridjax as hj
from hybridjax.identify.joint.realization import realized_htf
from hybridjax.identify.realization import realized


HARMONICS = (-2, -1, 0, 1, 2)
# What is not known of the hopper.
SPRING = ("k", "b")
EVERYTHING = ("M", "m", "k", "b", "l0", "g")
# Part of a parameter by which differences of multipliers are taken.
_ASIDE = 1e-4


def measured(
    data, design: hj.experiments.Design, noise: dict[str, float], harmonics, rng
) -> hj.linear.HTF:
    """HTFs from data with noise, whose variance is known."""
    std = np.array(list(noise.values()))
    noisy = hj.experiments.add_noise(data, std=std, seed=int(rng.integers(2**31)))
    htf = hj.estimate_htf(noisy, harmonics, variance="auto")
    each = design.expected_variance()[:, None, :] * std[:, None] ** 2
    return hj.linear.HTF(
        htf.frequencies,
        htf.H,
        htf.harmonics,
        htf.n_sections,
        htf.inputs,
        htf.outputs,
        variance=np.broadcast_to(each, htf.H.shape),
    )


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def goals(family, draws: int) -> None:
    """Bounds of other goals and with a limit of peaks; 620 lines."""
    design = hj.designs
    asked = {
        "fit_ldtp": design.MultiplierGoal(estimator="fit_ldtp", harmonics=HARMONICS),
        "response": design.ResponseGoal((0.1, 1.0), harmonics=HARMONICS),
    }
    for limit in ("input", "output"):
        for name, goal in asked.items():
            show(family, f"goals.{name}.{limit}", goal=goal, limit=limit)
    usual = hj.multisine(periods=16)
    peaks = design.Limits(rms={"u": 0.01}, peak={"u": 0.02})
    show(family, "goals.peak", usual, limit=peaks)


def show(family, name: str, *design, **about):
    begin = time.process_time()
    plan = hj.optimal_design(family.model, *design, **about)
    family.show(f"{name}.saved", plan.saved)
    family.show(f"{name}.certificate", plan.certificate)
    family.show(f"{name}.cpu_seconds", time.process_time() - begin)
    return plan


def parameters(family, draws: int) -> None:
    """Spring stiffness and damping by `fit_model`, the input limited."""
    usual = hj.multisine(periods=128, lines="odd").scaled(1e-4)
    before = family.recorded(usual)
    noise = family.noise(before[0])
    sections = family.placed.family
    goal = hj.designs.ParameterGoal(family.cycle, sections, SPRING, harmonics=HARMONICS)
    plan = hj.optimal_design(family.model, usual, goal=goal, noise=noise)
    system = family.cycle.system
    truth = np.array([float(getattr(system, name)) for name in SPRING])
    found = []
    for name, design, data in (
        ("usual", usual, before),
        ("optimal", plan.design, family.recorded(plan.design)),
    ):

        def error(rng, data=data, design=design, scale=1.0):
            std = {k: scale * x for k, x in noise.items()}
            htf = measured(data[rng.integers(len(data))], design, std, HARMONICS, rng)
            fit = hj.fit_model(
                system,
                hj.fitting.ObservedHTF(htf, sections),
                SPRING,
                guess=family.cycle,
            )
            return np.asarray(fit.values) / truth - 1

        errors = hj.scale.monte_carlo(error, draws, seed=3).value.values
        clean = error(np.random.default_rng(0), scale=1e-3)
        found.append(rms(np.linalg.norm(errors, axis=1)))
        family.show(f"parameters.{name}.rms_error", found[-1])
        family.show(f"parameters.{name}.without_noise", np.linalg.norm(clean))
    family.show("parameters.usual.bound", np.linalg.norm(plan.usual_standard_errors))
    family.show("parameters.optimal.bound", np.linalg.norm(plan.standard_errors))
    family.show("parameters.saved", (found[0] / found[1]) ** 2)


def deviation(family, draws: int) -> None:
    """Multipliers, deviations of both outputs limited: all the lines and `fit_multipliers` against
    a design for `fit_ldtp`, and that fit; beside it the bounds of physical models."""
    usual = hj.multisine(periods=128, lines="odd").scaled(0.001)
    before = family.recorded(usual)
    noise = family.noise(before[0])
    about = {"limit": "output", "noise": noise}
    free = hj.optimal_design(family.model, usual, **about)
    goal = hj.designs.MultiplierGoal(estimator="fit_ldtp")
    plan = hj.optimal_design(family.model, usual, goal=goal, **about)
    N, truth = family.model.n_sections, family.model.multipliers
    minimal = realized(np.asarray(family.model.impulse_response(4 * N + 1)))
    start = realized_htf(family.model.htf(usual.frequencies), np.asarray(minimal.dims))
    start = eqx.tree_at(lambda model: model.D, start, 0 * start.D)  # (and stays so)
    after = family.recorded(plan.design)

    def one(rng):
        k = rng.integers(len(before))
        htf = measured(before[k], usual, noise, HARMONICS, rng)
        error = {"numerators": hj.fit_multipliers(htf, 2).compare(truth).error[0]}
        for name, design, data in (
            ("ldtp", usual, before),
            ("together", plan.design, after),
        ):
            htf = measured(data[k], design, noise, range(-N // 2, N // 2), rng)
            begin = time.process_time()
            fit = hj.fit_ldtp(htf, initial=start)
            error[name] = np.abs(fit.multipliers - truth[0]).min()
            error[f"{name}.seconds"] = time.process_time() - begin
        return {name: float(x) for name, x in error.items()}

    found = hj.scale.monte_carlo(one, draws, seed=5)
    error = {x: rms(found[x].values) for x in ("numerators", "ldtp", "together")}
    bound = {
        "numerators": np.linalg.norm(free.usual_standard_errors),
        "ldtp": np.linalg.norm(plan.usual_standard_errors),
        "together": np.linalg.norm(plan.standard_errors),
    }
    for name, value in error.items():
        family.show(f"deviation.{name}.rms_error", value)
        family.show(f"deviation.{name}.bound", bound[name])
        family.show(f"deviation.{name}.saved", (error["numerators"] / value) ** 2)
    family.show(
        "deviation.ldtp.seconds", float(np.median(found["ldtp.seconds"].values))
    )
    for label, unknown in (("spring", SPRING), ("everything", EVERYTHING)):
        value = physical(family, usual, noise, unknown)
        family.show(f"deviation.{label}.bound", value)
        family.show(f"deviation.{label}.saved", (bound["numerators"] / value) ** 2)


def physical(
    family,
    design: hj.experiments.Design,
    noise: dict[str, float],
    free: tuple[str, ...],
) -> float:
    """Bound of the multiplier for whoever knows the equations, but not these parameters."""
    htf = family.model.htf(design.frequencies, HARMONICS)
    each = (
        design.expected_variance()[:, None, :]
        * np.array(list(noise.values()))[:, None] ** 2
    )
    htf = hj.linear.HTF(
        htf.frequencies,
        htf.H,
        HARMONICS,
        htf.n_sections,
        htf.inputs,
        OUTPUTS,
        variance=np.broadcast_to(each, htf.H.shape),
    )
    system, observed = (
        family.cycle.system,
        hj.fitting.ObservedHTF(htf, family.placed.family),
    )
    seen = hj.fitting.identifiability(system, observed, free, guess=family.cycle)
    slopes = []
    for name in free:
        values = [float(getattr(system, name)) * (1 + x) for x in (-_ASIDE, _ASIDE)]
        ends = [
            hj.find_limit_cycle(type(system)(**{name: x}), family.cycle) for x in values
        ]
        slopes.append((ends[1].multipliers[0] - ends[0].multipliers[0]) / (2 * _ASIDE))
    parts = np.stack([np.real(slopes), np.imag(slopes)])
    # (What the data do not see has no effect on the multipliers that they see.)
    return float(np.linalg.norm(parts @ np.linalg.pinv(seen.sensitivity, rcond=1e-7)))

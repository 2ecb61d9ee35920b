"""Result codes of numerical work: one per lane of a batch, the first failure wins.

A lane is one of many states that a program computes at once. The engine, orbits and experiments
record codes by `update_result`. Numbers are written into stores of sweeps and experiments, so that
a number must not get another meaning; a new code takes the next one. (2 is not in use.)

If a code is wrong, look for the first `update_result` in the computation that finds a failure:
later ones do not replace it. If a message does not help, change its sentence here, and not its
number.
"""

import enum

from jaxtyping import Bool, Int

from .executor import Array, namespace


class Result(enum.IntEnum):
    """Code for the success or the failure of a trajectory, an experiment or a solve; `message` is
    its meaning, as a sentence."""

    message: str

    def __new__(cls, code: int, message: str = "") -> "Result":
        self = int.__new__(cls, code)
        self._value_ = code
        self.message = message
        return self

    OK = 0, "ok"
    SECTION_MISSED = 1, "the section was not crossed within the time allowed"
    EVENT_ORDER = 3, "events came in another order or number than on the limit cycle"
    GRAZING = (
        4,
        "a guard or section was touched tangentially (grazing), or the state rests on it",
    )
    ZENO = (
        5,
        "events accumulate in finite time (Zeno): what comes to rest or slides there needs a chart "
        "of its own",
    )
    BLOW_UP = 6, "the state left all bounds"
    STEP_LIMIT = (
        7,
        "the limit on steps was reached; `Settings(max_steps=...)` raises it",
    )
    NOT_CONVERGED = 8, "the iteration did not converge"
    SINGULAR = 9, "J - I is singular: the cycle is not isolated"
    BAD_INPUT = (
        10,
        "the start, the end or the input is NaN or infinite, or the end comes before the start",
    )
    EQUILIBRIUM = 11, "the iteration ended in an equilibrium instead of a cycle"
    EXTRA_TURNS = (
        12,
        "the cycle closes sooner, or meets its section more often, than asked",
    )
    SIMULTANEOUS = (
        13,
        "two events coincide: trajectories nearby may meet them in either order",
    )
    STEP_COLLAPSE = (
        14,
        "steps shrank to nothing although the state hardly moves: a field that jumps must do so at "
        "the guard of a transition",
    )
    FIELD_NOT_FINITE = (
        15,
        "the field, a guard, its derivative or a reset is NaN or infinite: a division by zero, or "
        "a mass matrix that is singular or not positive definite there",
    )
    GUARD_PASSED = (
        16,
        "a reset put the state on a guard, through which it then went without an event: what comes "
        "to rest there needs a chart of its own",
    )
    PULSE_PASSED = (
        17,
        "the field or a guard has a pulse, or another sudden change, over which steps pass: begin "
        "and end it by transitions (`hj.systems.Scheduled` at known times)",
    )
    PLANT_STOPPED = 18, "the plant ended the experiment: see `data.simulated.causes`"
    GUARD_BEYOND = (
        19,
        "the cycle lies beyond a guard all along, so that its event can never happen",
    )
    NOT_VERIFIED = (
        20,
        "a check of the cycle failed: `find_limit_cycle` of its system says which",
    )


def update_result(
    result: Int[Array, "*lanes"], failed: Bool[Array, "*lanes"], code: Result
) -> Int[Array, "*lanes"]:
    """Record `code` where `failed`, unless an earlier failure is there already."""
    xp = namespace(failed)
    return xp.where((result == Result.OK) & failed, xp.int32(code), result)

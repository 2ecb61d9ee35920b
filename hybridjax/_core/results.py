"""Result codes of numerical work: one per lane of a batch, the first failure wins."""

import enum

from jaxtyping import Bool, Int

from .executor import Array, namespace


class Result(enum.IntEnum):
    """Code for the success or the failure of a trajectory, an experiment or a solve."""

    OK = 0
    SECTION_MISSED = 1
    EVENT_MISSED = 2
    EVENT_ORDER = 3
    GRAZING = 4
    ZENO = 5
    BLOW_UP = 6
    STEP_LIMIT = 7
    NOT_CONVERGED = 8
    SINGULAR = 9
    BAD_INPUT = 10
    EQUILIBRIUM = 11
    EXTRA_TURNS = 12
    COINCIDENCE = 13
    STEP_COLLAPSE = 14
    FIELD_NOT_FINITE = 15
    GUARD_PASSED = 16
    PULSE_PASSED = 17
    PLANT_STOPPED = 18

    @property
    def message(self) -> str:
        """The meaning of the code, as a sentence."""
        return _MESSAGES[self]


_MESSAGES = {
    Result.OK: "ok",
    Result.SECTION_MISSED: "the section was not crossed within the time allowed",
    Result.EVENT_MISSED: "the planned event did not happen within the time allowed",
    Result.EVENT_ORDER: "events came in another order or number than on the limit cycle",
    Result.GRAZING: "a guard or section was touched tangentially (grazing)",
    Result.ZENO: "events accumulate in finite time (Zeno)",
    Result.BLOW_UP: "the state left all bounds",
    Result.STEP_LIMIT: "the limit on steps was reached; `Settings(max_steps=...)` raises it",
    Result.NOT_CONVERGED: "the iteration did not converge",
    Result.SINGULAR: "J - I is singular: the cycle is not isolated",
    Result.BAD_INPUT: "the start or the input is NaN or infinite",
    Result.EQUILIBRIUM: "the iteration ended in an equilibrium instead of a cycle",
    Result.EXTRA_TURNS: "the cycle closes sooner, or meets its section more often, than asked",
    Result.COINCIDENCE: "two events coincide on the cycle: their order is not fixed beside it",
    Result.FIELD_NOT_FINITE: (
        "the field, a guard, its derivative or a reset is NaN or infinite: a division by zero, or "
        "a mass matrix that is singular there"
    ),
    Result.GUARD_PASSED: (
        "a reset put the state on a guard, through which it then went without an event: what comes "
        "to rest there needs a chart of its own"
    ),
    Result.PULSE_PASSED: (
        "the field or a guard has a pulse, or another sudden change, over which steps pass: begin "
        "and end it by transitions (`hj.Scheduled` at known times)"
    ),
    Result.PLANT_STOPPED: "the plant ended the experiment: see `data.simulated.causes`",
    Result.STEP_COLLAPSE: (
        "steps shrank to nothing although the state hardly moves: a field that jumps must do so at "
        "the guard of a transition"
    ),
}


def update_result(
    result: Int[Array, "*lanes"], failed: Bool[Array, "*lanes"], code: Result
) -> Int[Array, "*lanes"]:
    """Record `code` where `failed`, unless an earlier failure is there already."""
    xp = namespace(failed)
    return xp.where((result == Result.OK) & failed, xp.int32(code), result)

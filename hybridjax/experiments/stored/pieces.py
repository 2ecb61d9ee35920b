"""Experiments in pieces, for a store that any number of processes fill."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..._core.execution import Execution
from ..._core.pieces.blocks import Blocks
from ..._core.pieces.description import array_digest, definition_digest, digest_of, versions
from ..._core.pieces.layout import Constant, Layout, Variable
from ..._core.results import Result
from ..._core.signal import unit_of
from ...engine.describe import describe as describe_system
from ...errors import ComputationError
from ...orbits.cycle import LimitCycle, rough
from ...sections.placed import SectionsLike
from ...systems.output import OutputNames
from ..campaign import Campaign, prepare
from ..design.design import Design
from ..inputs import DesignLike
from ..options import Options


KIND = "experiments"
# Events of an experiment that are kept, for each of the limit cycle in the same time. Doubled,
# files are larger.
_MORE_EVENTS = 2


@dataclasses.dataclass(frozen=True)
class ExperimentJob:
    """**Fields:** `campaign`, in `blocks` of experiments."""

    campaign: Campaign
    blocks: Blocks

    def run(self, k: int, workers: int | None) -> dict[str, np.ndarray]:
        """The records of chunk k."""
        (rows,) = self.blocks.slices(k)
        data = self.campaign.by(Execution(workers=workers).threads).run(rows)
        found = {
            "u": data.u, "y": data.y, "result": data.result,
            "failed_at": data.failed_at, "error": data.error,
        }  # fmt: skip
        if data.events is not None:
            E = self.event_count
            if data.events.time.shape[1] > E:
                worst = rows.start + int(np.argmax(data.events.count))
                raise ComputationError(
                    f"experiment {worst} has more than {E} events, over {_MORE_EVENTS} for each of "
                    "the limit cycle: run it without `record_events`."
                )
            events = data.events
            found |= {"event_time": events.time, "event": events.event}
            found |= {"event_sample": events.sample}
            for name, fill in (("event_time", np.nan), ("event", -1), ("event_sample", -1)):
                width = ((0, 0), (0, E - found[name].shape[1]))
                found[name] = np.pad(found[name], width, constant_values=fill)
        return found

    @property
    def event_count(self) -> int:
        """Events of each experiment that are kept."""
        each = len(self.campaign.placed.cycle.event_sequence)
        return max(_MORE_EVENTS * each * self.campaign.inputs.cycles, 1)

    def arrays(self) -> list[np.ndarray]:
        """The numbers that pieces are computed from, beside inputs and parameters: those of the
        cycle, of sections on it, and of what they teach."""
        arrays = eqx.filter(self.campaign.taught, _is_array)
        return [np.asarray(x) for x in jax.tree_util.tree_leaves(arrays)]

    def restored(self, arrays: list[np.ndarray]) -> "ExperimentJob":
        """With these numbers of another call."""
        own, rest = eqx.partition(self.campaign.taught, _is_array)
        leaves, structure = jax.tree_util.tree_flatten(own)
        of_kind = [
            jax.numpy.asarray(new) if isinstance(old, jax.Array) else new
            for old, new in zip(leaves, arrays, strict=True)
        ]
        taught = eqx.combine(structure.unflatten(of_kind), rest)
        return dataclasses.replace(self, campaign=self.campaign.with_taught(taught))


def prepare_pieces(
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    options: Options,
    chunk: int,
) -> ExperimentJob:
    """The experiments as pieces, each of which is computed alike by one thread or many."""
    given = Execution() if options.execution is None else options.execution
    # (Batches as for one thread: their size does not depend on the machine.)
    alone = dataclasses.replace(options, execution=dataclasses.replace(given, workers=1))
    campaign = prepare(cycle, sections, design, outputs, alone, chunk, one_program=True)
    S = len(campaign.inputs)
    return ExperimentJob(campaign, Blocks((S,), (min(chunk, S),)))


def layout_of(job: ExperimentJob, description: dict[str, Any]) -> Layout:
    """What the store looks like."""
    campaign = job.campaign
    placed, inputs = campaign.placed, campaign.inputs
    n = inputs.cycles * placed.n_sections
    u, y = placed.cycle.system.inputs, campaign.outputs.names
    codes = {
        "flag_values": [int(x) for x in Result],
        "flag_meanings": " ".join(x.name.lower() for x in Result),
    }
    variables = {
        "u": Variable("<f8", ("sample", "input"), (n, len(u))),
        "y": Variable("<f8", ("sample", "output"), (n, len(y))),
        "result": Variable("<i8", attributes=codes),
        "failed_at": Variable("<i8"),
        "error": Variable("<f8"),
    }
    constants = {
        "input": Constant(("input",), np.array(list(map(str, u)))),
        "output": Constant(("output",), np.array(list(map(str, y)))),
        "cycle_outputs": Constant(("section", "output"), campaign.cycle_outputs()),
    }
    if campaign.record_events:
        cycle = campaign.cycle_events()
        events = ("occurrence",), (job.event_count,)
        unit = {"units": placed.cycle.system.time_unit or "1"}
        names = {"flag_meanings": " ".join(description["data"]["transitions"])}
        variables |= {
            "event_time": Variable("<f8", *events, unit),
            "event": Variable("<i8", *events, names),
            "event_sample": Variable("<i8", *events),
        }
        constants |= {
            "cycle_time": Constant(("cycle_event",), np.asarray(cycle.time[0])),
            "cycle_event": Constant(("cycle_event",), np.asarray(cycle.event[0])),
            "cycle_period": Constant((), np.asarray(placed.cycle.period)),
        }
    return Layout(
        ("experiment",), job.blocks, variables, constants, ("input", "output"), description
    )


def describe(job: ExperimentJob) -> dict[str, Any]:
    """What makes these experiments what they are."""
    campaign = job.campaign
    placed, inputs, noise = campaign.placed, campaign.inputs, campaign.process_noise
    system, outputs = placed.cycle.system, campaign.outputs.items
    return {
        "kind": KIND,
        "versions": versions(),
        "model": describe_system(system),
        "cycle": rough(placed.cycle),
        "family": definition_digest(placed.family),
        "design": _design(inputs.source),
        "start": campaign.start.name,
        "process_noise": None if noise is None else dataclasses.asdict(noise),
        "record_events": campaign.record_events,
        "accuracy": campaign.stepping.accuracy,
        "precision": campaign.execution.precision,
        "batch": campaign.execution.batch,
        "chunk": job.blocks.block[0],
        "experiments": job.blocks.shape[0],
        "cycles": inputs.cycles,
        "data": {
            "n_sections": placed.n_sections,
            "periods": inputs.periods,
            "inputs": [[str(x), unit_of(x)] for x in placed.structure().inputs],
            "outputs": [[str(x), unit_of(x)] for x in campaign.outputs.names],
            "label": placed.family.label,
            "transitions": [t.name for t in placed.structure().transitions],
        },
        "outputs": [x if isinstance(x, str) else definition_digest(x) for x in outputs],
    }


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray)


def _design(source: Design | np.ndarray) -> str:
    if isinstance(source, Design):
        arrays = jax.tree_util.tree_leaves(eqx.filter(source, eqx.is_array))
        return digest_of(*map(array_digest, arrays), repr(source.input_names))
    parts = (source[k : k + 1024] for k in range(0, len(source), 1024))  # (may lie on disk)
    return digest_of(*map(array_digest, parts))

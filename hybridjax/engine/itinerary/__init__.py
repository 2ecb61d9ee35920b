"""Trajectories whose charts and events are known, as data for one compiled program.

A search finds out in which order charts and events follow each other, and which steps reach the
accuracy. This is recorded as a table, the itinerary. Trajectories near the recorded one, with other
states or parameters, repeat its rows: nothing is searched, and derivatives are carried along.

    search (engine/search) -> tape -> legs -> rows -> table -> follow -> Passage

| file | has |
|---|---|
| `legs.py` | the tape, cut at its events |
| `rows.py`, `recorded.py` | the rows of the itinerary, and how they are written from legs |
| `table.py` | the same rows as few arrays that a program reads |
| `turn.py` | `follow`: the loop over the rows |
| `bodies.py`, `steps.py` | what a row does: events and sections; one step |
| `flags.py`, `watched.py` | whether the trajectory still follows the rows |
| `motion.py` | how one piece of code serves values and derivatives |

Where to look first: a wrong state or derivative comes from `bodies.py` or `steps.py`, a trajectory
that leaves its itinerary without need from `flags.py`, a wrong order of rows from `recorded.py`.
"""

"""Trajectories whose charts and events are known, as data for one compiled program.

A first search finds out in which order charts and events follow each other, and which steps reach
the accuracy. What comes near it again repeats them: `rows` records the search as a table,
`bodies` holds a step in each chart and a jump at each event, `turn` runs through the table.
"""

"""The part of the engine that decides: step sizes, which event comes first, when to give up.

In each iteration every lane takes aim (`aim`), attempts a step (`attempt`), and meets its outcome
(`outcome`). `search` is the loop around them, `state` what it carries, `stride` how lanes set out.
"""

"""A planar walker in MuJoCo, kept on its cycle by a small controller."""

import math
import pathlib

import mujoco

import hybridjax as hj


FILE = pathlib.Path(__file__).parent / "walker.xml"
PERIOD = 0.8


def control(model, data):
    """The legs swing and shorten in turn, by a clock. The foot is placed ahead by the speed, and
    the leg on the ground holds the torso upright."""
    _, z, pitch, left, _, right, _ = data.qpos
    speed, _, rate, left_rate, _, right_rate, _ = data.qvel
    if z < 0.7 or abs(pitch) > 1:
        raise hj.errors.ComputationError("fell")
    phase = math.sin(2 * math.pi * data.time / PERIOD)
    swings = 0.5 + 0.5 * math.tanh(4 * phase)  # 1: left, 0: right
    ahead = speed * PERIOD / 4 + 0.3 * (speed - 0.4)
    torso = -150 * pitch - 20 * rate
    pull_left = 60 * (ahead - pitch - left)
    brake_left = 7.5 * (rate + left_rate)
    swing_left = pull_left - brake_left
    pull_right = 60 * (ahead - pitch - right)
    brake_right = 7.5 * (rate + right_rate)
    swing_right = pull_right - brake_right
    return [
        swings * swing_left - (1 - swings) * (torso + swing_right),
        (1 - swings) * swing_right - swings * (torso + swing_left),
        -480 * max(0.0, phase) ** 2,
        -480 * max(0.0, -phase) ** 2,
        0.0,
    ]


def walker():
    model = mujoco.MjModel.from_xml_path(str(FILE))
    return hj.plants.MuJoCoPlant(
        model, {"push": "N"}, control=control, period=PERIOD, substeps=40
    )


def coordinates(plant):
    """All states, without the distance walked and, at clock sections, the time."""
    return [name for name in plant.states if name not in ("time", "x")]

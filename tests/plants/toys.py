"""A plant in closed form, and plants that fail."""

import math
import os
import time


class Circle:
    """The distance from the unit circle, which the input changes, decays at a rate of 0.2.
    The angle grows at a rate of 1: the multiplier is exp(-0.4 pi)."""

    inputs = {"push": "m/s"}
    units = {"x": "m"}
    states = ("x", "y")
    dt = 0.1
    rate = 0.2

    def reset(self, seed):
        self.seed = seed
        self.steps = 0
        return self.set_state((0.5, 0.0))

    def get_state(self):
        return self.q

    def set_state(self, q):
        self.q = tuple(map(float, q))
        return {"x": self.q[0], "y": self.q[1]}

    def step(self, u, duration):
        self.steps += 1
        r = math.hypot(*self.q)
        begin = math.atan2(self.q[1], self.q[0])
        angle = begin + duration
        rest = 1 + u[0] / self.rate
        decay = math.exp(-self.rate * duration)
        r = rest + (r - rest) * decay
        x = r * math.cos(angle)
        y = r * math.sin(angle)
        return self.set_state((x, y))


class Troubled(Circle):
    """Fails in its own way for each seed above 1, after some steps."""

    def step(self, u, duration):
        observation = super().step(u, duration)
        late = self.seed if self.steps > 60 else 0
        if late == 2:
            raise ValueError("the hip broke")
        if late == 3:
            time.sleep(600)
        if late == 4:
            observation["y"] = math.nan
        if late == 5:
            return {"x": 1.0, "z": 1.0}
        if self.seed == 6:
            observation["x"] += 1e-9 * time.perf_counter()
        if late == 7:
            os._exit(3)
        if late == 8:
            self.q = (1.0, 0.0)
        return observation

"""Smooth oscillators of textbooks, fixed before the first run of hybridjax on them.

Later models get a new file. Afterwards only errors against the sources are mended here.
"""

from form import Model, Start, around


def van_der_pol(mu: float) -> Model:
    def field(xp, t, q, p):
        x, v = q
        return v, p.mu * (1 - x**2) * v - x

    return Model(
        name=f"van der Pol, mu = {mu}",
        source="Strogatz, Nonlinear Dynamics and Chaos, 1994, Sec. 7.1, 7.5, 7.6",
        charts={"plane": (("x", "v"), field)},
        parameters={"mu": mu},
        guesses=(
            *around("plane", (2.0, 0.1)),
            Start("plane", (0.0, 0.0), kind="equilibrium"),
            Start("plane", (1e-3, 0.0), kind="near the equilibrium"),
            Start("plane", (0.0, 30.0), kind="far"),
            Start("plane", (-5.0, 2.0), kind="far"),
            Start("plane", (1.0, -1.0), kind="poor"),
        ),
    )


def rayleigh() -> Model:
    def field(xp, t, q, p):
        x, v = q
        return v, p.eps * (v - v**3 / 3) - x

    return Model(
        name="Rayleigh",
        source="Jordan and Smith, Nonlinear Ordinary Differential Equations, 2007, Ch. 4",
        charts={"plane": (("x", "v"), field)},
        parameters={"eps": 0.5},
        guesses=(
            *around("plane", (2.0, 0.1)),
            Start("plane", (0.0, 0.0), kind="equilibrium"),
            Start("plane", (0.01, 0.01), kind="near the equilibrium"),
            Start("plane", (0.0, 8.0), kind="far"),
            Start("plane", (20.0, -1.0), kind="far"),
        ),
    )


def duffing() -> Model:
    def field(xp, t, q, p):
        x, v = q
        return v, x - x**3 - p.delta * v + p.gamma * xp.cos(p.omega * t)

    return Model(
        name="Duffing with two wells, forced",
        source="Guckenheimer and Holmes, Nonlinear Oscillations, 1983, Sec. 2.2",
        charts={"plane": (("x", "v"), field)},
        parameters={"delta": 0.25, "gamma": 0.2, "omega": 1.0},
        clock=lambda p: 2 * 3.141592653589793 / p.omega,
        guesses=(
            *around("plane", (1.0, 0.1)),
            Start("plane", (-1.0, 0.0), kind="other well"),
            Start("plane", (0.0, 0.0), kind="saddle"),
            Start("plane", (1.5, 1.0), 2.0, kind="poor"),
            Start("plane", (-8.0, 5.0), kind="far"),
            Start("plane", (0.3, -0.3), 1e4, kind="late"),
        ),
        truth="several: one small cycle in each well, a saddle cycle, perhaps large ones",
    )


def duffing_hardening() -> Model:
    def field(xp, t, q, p):
        x, v = q
        return v, -x - p.beta * x**3 - p.c * v + p.force * xp.cos(p.omega * t)

    return Model(
        name="Duffing, hardening, two amplitudes",
        source="Nayfeh and Mook, Nonlinear Oscillations, 1979, Sec. 4.1",
        charts={"plane": (("x", "v"), field)},
        parameters={"beta": 1.0, "c": 0.1, "force": 0.5, "omega": 1.6},
        clock=lambda p: 2 * 3.141592653589793 / p.omega,
        guesses=(
            *around("plane", (1.5, 0.5)),
            Start("plane", (0.0, 0.0), kind="rest"),
            Start("plane", (-0.3, 0.0), 0.1, kind="lower branch"),
            Start("plane", (3.0, -3.0), 1.0, kind="far"),
            Start("plane", (-30.0, 0.0), kind="far"),
            Start("plane", (1.0, 1.0), -50.0, kind="early"),
        ),
        truth="two stable cycles and a saddle between them",
    )


def fitzhugh_nagumo() -> Model:
    def field(xp, t, q, p):
        v, w = q
        return v - v**3 / 3 - w + p.current, (v + p.a - p.b * w) / p.tau

    return Model(
        name="FitzHugh-Nagumo",
        source="FitzHugh, Biophysical Journal 1, 1961, p. 445",
        charts={"plane": (("v", "w"), field)},
        parameters={"a": 0.7, "b": 0.8, "tau": 12.5, "current": 0.5},
        guesses=(
            *around("plane", (1.5, 0.5)),
            Start("plane", (-0.8048, -0.1310), kind="close to the equilibrium"),
            Start("plane", (0.0, 0.0), kind="poor"),
            Start("plane", (-2.0, 2.0), kind="far"),
            Start("plane", (5.0, -5.0), kind="far"),
        ),
    )


def fitzhugh_nagumo_rest() -> Model:
    def field(xp, t, q, p):
        v, w = q
        return v - v**3 / 3 - w + p.current, (v + p.a - p.b * w) / p.tau

    return Model(
        name="FitzHugh-Nagumo at rest",
        source="FitzHugh, Biophysical Journal 1, 1961, p. 445",
        charts={"plane": (("v", "w"), field)},
        parameters={"a": 0.7, "b": 0.8, "tau": 12.5, "current": 0.0},
        guesses=(
            *around("plane", (1.5, 0.5)),
            Start("plane", (-1.1994, -0.6243), kind="close to the equilibrium"),
            Start("plane", (0.0, 0.0), kind="poor"),
            Start("plane", (-2.0, 2.0), kind="far"),
        ),
        truth="no cycle: the rest state is stable",
    )


def brusselator() -> Model:
    def field(xp, t, q, p):
        x, y = q
        return p.a + x**2 * y - (p.b + 1) * x, p.b * x - x**2 * y

    return Model(
        name="Brusselator",
        source="Prigogine and Lefever, Journal of Chemical Physics 48, 1968, p. 1695",
        charts={"plane": (("x", "y"), field)},
        parameters={"a": 1.0, "b": 3.0},
        guesses=(
            *around("plane", (1.0, 4.0)),
            Start("plane", (1.0, 3.0), kind="equilibrium"),
            Start("plane", (1.0, 3.001), kind="near the equilibrium"),
            Start("plane", (0.0, 0.0), kind="corner"),
            Start("plane", (10.0, 0.1), kind="far"),
        ),
    )


def lotka_volterra() -> Model:
    def field(xp, t, q, p):
        prey, hunter = q
        return prey * (p.a - p.b * hunter), hunter * (p.c * prey - p.d)

    return Model(
        name="Lotka-Volterra",
        source="Murray, Mathematical Biology I, 2002, Sec. 3.1",
        charts={"plane": (("prey", "hunter"), field)},
        parameters={"a": 1.0, "b": 0.5, "c": 0.25, "d": 0.75},
        guesses=(
            *around("plane", (3.0, 3.0)),
            Start("plane", (3.0, 2.0), kind="equilibrium"),
            Start("plane", (0.0, 0.0), kind="saddle"),
            Start("plane", (5.0, 0.0), kind="invariant axis"),
            Start("plane", (0.0, 3.0), kind="invariant axis"),
            Start("plane", (3.0, 2.0001), kind="near the center"),
        ),
        truth="a family of cycles, none isolated: must be refused",
    )


def selkov() -> Model:
    def field(xp, t, q, p):
        x, y = q
        return -x + p.a * y + x**2 * y, p.b - p.a * y - x**2 * y

    return Model(
        name="Selkov, glycolysis",
        source="Strogatz, Nonlinear Dynamics and Chaos, 1994, Sec. 7.3",
        charts={"plane": (("x", "y"), field)},
        parameters={"a": 0.08, "b": 0.6},
        guesses=(
            *around("plane", (1.0, 1.0)),
            Start("plane", (0.6, 0.6 / 0.44), kind="equilibrium"),
            Start("plane", (0.0, 7.5), kind="corner of the trapping region"),
            Start("plane", (0.0, 0.0), kind="corner"),
            Start("plane", (0.1, 3.0), kind="poor"),
        ),
    )


def circle() -> Model:
    def field(xp, t, q, p):
        x, y = q
        r2 = x**2 + y**2
        return x * (1 - r2) - y, y * (1 - r2) + x

    return Model(
        name="circle r' = r (1 - r^2)",
        source="Strogatz, Nonlinear Dynamics and Chaos, 1994, Example 7.1.1",
        charts={"plane": (("x", "y"), field)},
        guesses=(
            *around("plane", (1.0, 0.0)),
            Start("plane", (0.0, 0.0), kind="equilibrium"),
            Start("plane", (0.0, 1e-9), kind="near the equilibrium"),
            Start("plane", (-7.0, 7.0), kind="far"),
            Start("plane", (0.6, 0.8), kind="on the cycle"),
        ),
    )


def subcritical_hopf() -> Model:
    def field(xp, t, q, p):
        x, y = q
        r2 = x**2 + y**2
        growth = p.mu + r2 - r2**2
        return growth * x - y * (p.omega + p.b * r2), growth * y + x * (
            p.omega + p.b * r2
        )

    return Model(
        name="subcritical Hopf, two cycles",
        source="Strogatz, Nonlinear Dynamics and Chaos, 1994, Sec. 8.2",
        charts={"plane": (("x", "y"), field)},
        parameters={"mu": -0.1, "omega": 1.0, "b": 0.3},
        guesses=(
            *around("plane", (0.94, 0.0)),
            Start("plane", (0.34, 0.0), kind="unstable cycle"),
            Start("plane", (0.3, 0.0), kind="inside of the unstable cycle"),
            Start("plane", (0.0, -0.7), kind="between the cycles"),
            Start("plane", (0.0, 0.0), kind="equilibrium"),
            Start("plane", (4.0, -4.0), kind="far"),
        ),
        truth="a stable and an unstable cycle around a stable equilibrium",
    )


def lorenz(rho: float, truth: str) -> Model:
    def field(xp, t, q, p):
        x, y, z = q
        return p.sigma * (y - x), p.rho * x - y - x * z, x * y - p.beta * z

    return Model(
        name=f"Lorenz, rho = {rho}",
        source="Sparrow, The Lorenz Equations, 1982, Ch. 4; Strogatz, 1994, Ch. 9",
        charts={"space": (("x", "y", "z"), field)},
        parameters={"sigma": 10.0, "rho": rho, "beta": 8 / 3},
        guesses=(
            *around("space", (10.0, 10.0, rho - 1)),
            Start("space", (0.0, 0.0, 0.0), kind="equilibrium"),
            Start("space", (0.0, 0.0, 10.0), kind="stable manifold of the origin"),
            Start(
                "space",
                ((8 / 3 * (rho - 1)) ** 0.5, (8 / 3 * (rho - 1)) ** 0.5, rho - 1),
                kind="equilibrium",
            ),
            Start("space", (-13.0, -20.0, rho - 4), kind="poor"),
        ),
        truth=truth,
    )


def roessler(c: float, truth: str) -> Model:
    def field(xp, t, q, p):
        x, y, z = q
        return -y - z, x + p.a * y, p.b + z * (x - p.c)

    return Model(
        name=f"Roessler, c = {c}",
        source="Strogatz, Nonlinear Dynamics and Chaos, 1994, Sec. 12.3",
        charts={"space": (("x", "y", "z"), field)},
        parameters={"a": 0.2, "b": 0.2, "c": c},
        guesses=(
            *around("space", (3.0, -2.0, 0.3)),
            Start("space", (0.0, 0.0, 0.0), kind="poor"),
            Start("space", (0.0, -4.0, 0.1), kind="fair"),
            Start("space", (0.016, -0.08, 0.08), kind="near the equilibrium"),
            Start("space", (0.0, 0.0, 50.0), kind="far"),
        ),
        truth=truth,
    )


def goodwin() -> Model:
    def field(xp, t, q, p):
        x, y, z = q
        return 1 / (1 + z**10) - p.k * x, x - p.k * y, y - p.k * z

    return Model(
        name="Goodwin",
        source="Murray, Mathematical Biology I, 2002, Sec. 7.2",
        charts={"space": (("x", "y", "z"), field)},
        parameters={"k": 0.3},
        guesses=(
            *around("space", (0.1, 0.4, 1.5)),
            Start("space", (0.0, 0.0, 0.0), kind="corner"),
            Start("space", (1.0, 1.0, 1.0), kind="poor"),
            Start("space", (0.1236, 0.412, 1.3733), kind="near the equilibrium"),
            Start("space", (0.0, 5.0, 0.0), kind="far"),
        ),
    )


def morris_lecar() -> Model:
    def field(xp, t, q, p):
        v, w = q
        m = 0.5 * (1 + xp.tanh((v + 1.2) / 18))
        target = 0.5 * (1 + xp.tanh((v - 2) / 30))
        rate = p.phi * xp.cosh((v - 2) / 60)
        calcium = 4.4 * m * (v - 120)
        potassium = 8 * w * (v + 84)
        leak = 2 * (v + 60)
        return (p.current - calcium - potassium - leak) / 20, rate * (target - w)

    return Model(
        name="Morris-Lecar, bistable",
        source="Rinzel and Ermentrout, in: Koch and Segev, Methods in Neuronal Modeling, 1989",
        charts={"membrane": (("v", "w"), field)},
        parameters={"phi": 0.04, "current": 90.0},
        guesses=(
            *around("membrane", (20.0, 0.3)),
            Start("membrane", (-26.6, 0.13), kind="near the rest"),
            Start("membrane", (-40.0, 0.1), kind="poor"),
            Start("membrane", (0.0, 0.0), kind="poor"),
            Start("membrane", (-24.0, 0.15), kind="near the unstable cycle"),
        ),
        truth="a stable and an unstable cycle around a stable equilibrium",
    )


def hindmarsh_rose(current: float) -> Model:
    def field(xp, t, q, p):
        x, y, z = q
        fast = y - x**3 + 3 * x**2 - z + p.current
        return fast, 1 - 5 * x**2 - y, p.r * (4 * (x + 1.6) - z)

    return Model(
        name=f"Hindmarsh-Rose, I = {current}",
        source="Hindmarsh and Rose, Proceedings of the Royal Society B 221, 1984, p. 87",
        charts={"membrane": (("x", "y", "z"), field)},
        parameters={"r": 0.01, "current": current},
        guesses=(
            *around("membrane", (1.5, -3.0, current)),
            Start("membrane", (0.0, 0.0, 0.0), kind="poor"),
            Start("membrane", (-1.3, -7.5, 1.6), kind="silent phase"),
            Start("membrane", (-0.5, 0.0, 3.0), kind="poor"),
            Start("membrane", (2.0, -10.0, 1.0), kind="poor"),
        ),
        truth="stable bursts or spikes, and unstable cycles of the fast motion",
    )


def forced_pendulum() -> Model:
    def field(xp, t, q, p):
        angle, rate = q
        return rate, -rate / p.q - xp.sin(angle) + p.g * xp.cos(p.omega * t)

    return Model(
        name="forced pendulum",
        source="Baker and Gollub, Chaotic Dynamics, 1996, Ch. 3",
        charts={"swing": (("angle", "rate"), field)},
        parameters={"q": 2.0, "g": 0.9, "omega": 2 / 3},
        clock=lambda p: 2 * 3.141592653589793 / p.omega,
        guesses=(
            *around("swing", (1.0, 0.5)),
            Start("swing", (3.141592653589793, 0.0), kind="upright"),
            Start("swing", (0.0, 0.0), kind="rest"),
            Start("swing", (6.283185307179586, 0.0), kind="one turn further"),
            Start("swing", (0.0, 10.0), kind="far"),
            Start("swing", (-1.0, 1.0), 4.0, kind="poor"),
        ),
        truth="a stable swing, unstable ones near the upright position",
    )


def mathieu(multiplicity: int) -> Model:
    def field(xp, t, q, p):
        x, v = q
        stiffness = p.delta + p.eps * xp.cos(t)
        return v, -p.c * v - stiffness * x - x**3

    return Model(
        name=f"Mathieu with a cubic spring, {multiplicity} periods",
        source="Nayfeh and Mook, Nonlinear Oscillations, 1979, Sec. 5.7",
        charts={"plane": (("x", "v"), field)},
        parameters={"delta": 0.25, "eps": 0.2, "c": 0.05},
        clock=lambda p: 2 * 3.141592653589793,
        search={} if multiplicity == 1 else {"multiplicity": multiplicity},
        guesses=(
            *around("plane", (0.3, 0.1)),
            Start("plane", (0.0, 0.0), kind="equilibrium"),
            Start("plane", (0.5, 0.0), kind="poor"),
            Start("plane", (2.0, 2.0), 1.0, kind="far"),
            Start("plane", (0.0, -0.4), 3.0, kind="poor"),
        ),
        truth="rest is unstable; a stable motion of two periods of the drive, and its mirror",
    )


def predator_prey() -> Model:
    def field(xp, t, q, p):
        prey, hunter = q
        eaten = p.a * prey * hunter / (1 + p.h * prey)
        return prey * (1 - prey / p.k) - eaten, eaten - p.m * hunter

    return Model(
        name="Rosenzweig-MacArthur",
        source="Rosenzweig and MacArthur, American Naturalist 97, 1963, p. 209",
        charts={"plane": (("prey", "hunter"), field)},
        parameters={"a": 2.0, "h": 1.0, "k": 5.0, "m": 1.0},
        guesses=(
            *around("plane", (1.0, 1.5)),
            Start("plane", (1.0, 0.8), kind="equilibrium"),
            Start("plane", (0.0, 0.0), kind="saddle"),
            Start("plane", (5.0, 0.0), kind="saddle"),
            Start("plane", (3.0, 0.01), kind="poor"),
            Start("plane", (0.0, 1.0), kind="invariant axis"),
        ),
    )


def repressilator() -> Model:
    def field(xp, t, q, p):
        def made(protein):
            return p.leak + p.alpha / (1 + protein**p.n)

        return (
            made(q[5]) - q[0],
            made(q[3]) - q[1],
            made(q[4]) - q[2],
            p.beta * (q[0] - q[3]),
            p.beta * (q[1] - q[4]),
            p.beta * (q[2] - q[5]),
        )

    return Model(
        name="repressilator",
        source="Elowitz and Leibler, Nature 403, 2000, p. 335",
        charts={"cell": (("m1", "m2", "m3", "p1", "p2", "p3"), field)},
        parameters={"alpha": 50.0, "leak": 0.05, "beta": 0.5, "n": 2.5},
        guesses=(
            *around("cell", (10.0, 2.0, 1.0, 8.0, 4.0, 1.0)),
            Start("cell", (0.0,) * 6, kind="symmetric"),
            Start("cell", (3.0,) * 6, kind="symmetric"),
            Start("cell", (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), kind="poor"),
            Start("cell", (50.0, 0.0, 0.0, 0.0, 50.0, 0.0), kind="far"),
        ),
    )


def damped() -> Model:
    def field(xp, t, q, p):
        x, v = q
        return v, -x - p.c * v

    return Model(
        name="damped linear oscillator",
        source="Strogatz, Nonlinear Dynamics and Chaos, 1994, Ch. 5",
        charts={"plane": (("x", "v"), field)},
        parameters={"c": 0.02},
        guesses=(
            *around("plane", (1.0, 0.2)),
            Start("plane", (0.0, 0.0), kind="equilibrium"),
            Start("plane", (0.0, 1e-8), kind="near the equilibrium"),
            Start("plane", (-3.0, 4.0), kind="far"),
        ),
        truth="no cycle",
    )


def pendulum() -> Model:
    def field(xp, t, q, p):
        angle, rate = q
        return rate, -xp.sin(angle)

    return Model(
        name="pendulum without friction",
        source="Strogatz, Nonlinear Dynamics and Chaos, 1994, Sec. 6.7",
        charts={"swing": (("angle", "rate"), field)},
        guesses=(
            *around("swing", (1.0, 0.2)),
            Start("swing", (0.0, 0.0), kind="equilibrium"),
            Start("swing", (3.141592653589793, 0.0), kind="saddle"),
            Start("swing", (0.0, 2.0), kind="separatrix"),
            Start("swing", (0.0, 2.5), kind="rotation"),
        ),
        truth="a family of cycles, none isolated: must be refused",
    )


MODELS = (
    van_der_pol(0.01),
    van_der_pol(1.0),
    van_der_pol(6.0),
    van_der_pol(20.0),
    rayleigh(),
    duffing(),
    duffing_hardening(),
    fitzhugh_nagumo(),
    fitzhugh_nagumo_rest(),
    brusselator(),
    lotka_volterra(),
    selkov(),
    circle(),
    subcritical_hopf(),
    lorenz(28.0, "chaos: only unstable cycles"),
    lorenz(160.0, "a stable symmetric cycle, and unstable ones"),
    roessler(2.5, "one stable cycle"),
    roessler(3.5, "a stable cycle of two turns, an unstable one of one turn"),
    goodwin(),
    morris_lecar(),
    hindmarsh_rose(1.5),
    hindmarsh_rose(4.0),
    forced_pendulum(),
    mathieu(1),
    mathieu(2),
    predator_prey(),
    repressilator(),
    damped(),
    pendulum(),
)

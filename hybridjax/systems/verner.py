"""`VERNER76`, the Runge-Kutta method of charts that name no other: Verner's efficient 7(6) pair
with ten stages.

J. H. Verner, Numerically optimal Runge-Kutta pairs with interpolants, Numer. Algorithms 53 (2010)
383-396. The efficient 6(5) pair of the same paper needs two stages less, but its weights of +-176
cancel and leave rounding errors of 1e-12 in each step; here the weights stay below 0.5.
"""

from .solver import Method


def _verner() -> Method:
    # fmt: off
    a = (
        (),
        (0.005,),
        (-1.07679012345679, 1.185679012345679),
        (0.04083333333333333, 0.0, 0.1225),
        (0.6389139236255726, 0.0, -2.455672638223657, 2.272258714598084),
        (-2.6615773750187572, 0.0, 10.804513886456137, -8.3539146573962, 0.820487594956657),
        (6.067741434696771, 0.0, -24.711273635911084, 20.427517930788895, -1.9061579788166472,
         1.006172249242068),
        (12.054670076253203, 0.0, -49.75478495046899, 41.142888638604674, -4.461760149974004,
         2.042334822239175, -0.09834843665406108),
        (10.138146522881808, 0.0, -42.6411360317175, 35.76384003992257, -4.3480228403929075,
         2.0098622683770357, 0.3487490460338272, -0.27143900510483127),
        (-45.030072034298676, 0.0, 187.3272437654589, -154.02882369350186, 18.56465306347536,
         -7.141809679295079, 1.3088085781613785, 0.0, 0.0),
    )
    b = (0.04715561848627222, 0.0, 0.0, 0.25750564298434153, 0.2621665397741262,
         0.15216092656738558, 0.49399691700324844, -0.29430311714032503, 0.0813174723249511, 0.0)
    embedded = (0.044608606606341174, 0.0, 0.0, 0.26716403785713727, 0.2201018300177293,
                0.2188431703143157, 0.22898717054112028, 0.0, 0.0, 0.020295184663356284)
    c = (0.0, 0.005, 0.10888888888888888, 0.16333333333333333, 0.4555, 0.6095094489978381, 0.884,
         0.925, 1.0, 1.0)
    # fmt: on (The estimate has order 7. Steps are controlled by an eighth root, which is three
    # square roots and nearly as good.)
    return Method(
        "Verner 7(6)",
        a=tuple(row + (len(b) - len(row)) * (0.0,) for row in a),
        b=b,
        c=c,
        error=tuple(x - y for x, y in zip(b, embedded, strict=True)),
        order=8.0,
    )


VERNER76 = _verner()

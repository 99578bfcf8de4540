"""Damped oscillator with unknown damping and stiffness, of which only the position is measured.

G. T. Schmidt, Sc.D. thesis, M.I.T. 1971, sections 5.4 and 5.5. The unit of y is arbitrary; the source gives no units.

    y'' + a y' + b y = u + n,   m = y + v,   (y, y') from (0, 0) to (10, 0) in T = 10 s
    means: a = 2.51 1/s, b = 3.15 1/s^2;   densities: <n n'> = 0.005 delta, <v v'> = 0.05 delta
    variances at the start: 0.1 of y and y', 0.2 of a and b;   J = C33 E_aa(T) + C44 E_bb(T) + int_0^T u^2/2 dt

The source exchanges a and b in [5.4-2], [5.4-7] and [5.4-17] to [5.4-19] against [5.4-1]. Naming "table" follows
[5.4-1], as the source's table 5-1 does (natural frequency 1.775 rad/s, damping ratio 0.707); naming "equations" follows
[5.4-2], y'' + b y' + a y = u + n (1.584 rad/s, 0.994, the "critically damped" of the text). Converged values; the least
energy that reaches (10, 0) is 790.65 in both:

| naming    | weight      | J          | energy     | E_yy(T)   | E_y'y'(T) | E_aa(T)   | E_bb(T)   |
|-----------|-------------|------------|------------|-----------|-----------|-----------|-----------|
| table     | none        | 790.650000 | 790.650000 | 0.1256963 | 0.5002708 | 0.0482620 | 0.1258844 |
| table     | C33 = 1000  | 824.793839 | 798.205325 | 0.1204984 | 0.4155369 | 0.0265885 | 0.0873026 |
| table     | C44 = 1000  | 863.839329 | 816.064615 | 0.0941239 | 0.2135334 | 0.0220242 | 0.0477747 |
| equations | none        | 790.650000 | 790.650000 | 0.0899887 | 0.2504635 | 0.0990639 | 0.1008523 |
| equations | C33 = 1000  | 847.415448 | 812.428816 | 0.0690707 | 0.0901272 | 0.0349866 | 0.0416234 |
| equations | second min. | 847.855502 | 813.450947 | 0.0659783 | 0.0797048 | 0.0344046 | 0.0592464 |
| equations | C44 = 1000  | 844.788719 | 809.421708 | 0.0852168 | 0.1573384 | 0.0493841 | 0.0353670 |

The source's table 5-1 (E_yy, E_y'y', E_aa, E_bb; energy): no weight 0.126, 0.506, 0.048, 0.123; 798. C33: 0.115,
0.377, 0.024, 0.075; 817. C44: 0.093, 0.215, 0.024, 0.049; 830. Its energy integral is int u^2/2. Errata: in [5.4-20]
read dP/dt.
"""

from __future__ import annotations

import covocp as co

DURATION = 10.0  # s
FINAL = 10.0  # [y]
MEANS = {"a": 2.51, "b": 3.15}  # 1/s and 1/s^2 in the naming "table", the other way round in "equations"
PARAMETER_VARIANCE = 0.2  # of each
INITIAL_VARIANCE = 0.1  # [y]^2 and ([y]/s)^2
PROCESS_NOISE = 0.005  # ([y]/s)^2/s
NAMINGS = ("table", "equations")


def problem(
    damping_weight: float = 0.0,
    stiffness_weight: float = 1000.0,
    measurement_noise: float = 0.05,
    naming: str = "table",
) -> co.Problem:
    """Damped oscillator with unknown damping and stiffness, Schmidt [5.4].

    Args:
        damping_weight: C33, of the terminal variance of a (parameter "damping_weight").
        stiffness_weight: C44, of the terminal variance of b (parameter "stiffness_weight").
        measurement_noise: power spectral density of the measurement noise [y^2 s].
        naming: "table": a is the damping and b the stiffness [5.4-1]; "equations": the other way round [5.4-2].

    Returns:
        The problem, with states "y" and "rate", unknowns "a" and "b", control "u", measurement "position" and
        covariance "E" of (y, rate, a, b).

    Raises:
        ProblemError: where the naming is unknown, or the measurement noise not positive.
    """
    if naming not in NAMINGS:
        raise co.ProblemError(
            "The damped oscillator has no such naming of its parameters.\n"
            "  expected: 'table' (a the damping, b the stiffness) or 'equations' (the other way round)\n"
            f"  received: {naming!r}\n"
            "  remedy:   choose one of the two"
        )
    ocp = co.Problem(duration=DURATION, name="damped oscillator, unknown damping and stiffness")
    C33 = ocp.parameter("damping_weight", damping_weight)
    C44 = ocp.parameter("stiffness_weight", stiffness_weight)
    y = ocp.state("y", initial=0.0, final=FINAL, variance=INITIAL_VARIANCE)
    rate = ocp.state("rate", initial=0.0, final=0.0, variance=INITIAL_VARIANCE)
    a, b = (ocp.unknown(name, mean=mean, variance=PARAMETER_VARIANCE) for name, mean in MEANS.items())
    damping, stiffness = (a, b) if naming == "table" else (b, a)
    u = ocp.control("u")
    ocp.dynamics(y, rate)
    ocp.dynamics(rate, -stiffness * y - damping * rate + u, noise=PROCESS_NOISE)
    ocp.measurement("position", y, noise=measurement_noise)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.5 * u**2, terminal=C33 * E[a, a] + C44 * E[b, b])
    return ocp


def figures() -> dict[str, list[tuple[str, co.Problem]]]:
    """What the figures of Schmidt 5.4 and 5.5 show: no weight, one on the damping, one on the stiffness; by title."""
    weights = {
        "no weight": (0.0, 0.0),
        "weight on the damping": (1000.0, 0.0),
        "weight on the stiffness": (0.0, 1000.0),
    }
    return {
        "Schmidt 5.4: identification of damping and stiffness": [
            (label, problem(damping_weight=a, stiffness_weight=b)) for label, (a, b) in weights.items()
        ]
    }

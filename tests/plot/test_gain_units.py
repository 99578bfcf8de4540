"""Units of gains on the axes: of the feedback per deviation, of the filter per measured value and second."""

import numpy as np
from figures import entries_of, panels, values_of

import covocp as co


def moving(measured, unit="m", size=1, **units):
    """Position and speed [m, m/s], measured by what `measured` adds; the loop is closed."""
    ocp = co.Problem(2.0)
    p = ocp.state("p", size, initial=0.0, final=1.0, variance=1.0, unit=unit)
    v = ocp.state("v", size, initial=0.0, variance=0.5, unit="m/s")
    u = ocp.control("u", size, unit=units.get("u", "m/s^2"))
    ocp.dynamics(p, v)
    ocp.dynamics(v, u, noise=0.1)
    measured(ocp, p, v)
    ocp.minimize_expected(running=sum(u[i] ** 2 for i in range(size)), terminal_weight={p: 1.0})
    return co.solve(ocp, intervals=4, substeps=2, progress=False, allow_failure=True, max_iterations=0)


def labels(solution, *names, **options):
    return list(panels(solution.plot(*(names or ("K",)), **options)))


def test_filter_gain_has_the_unit_of_the_state_per_measurement_and_second():
    solution = moving(lambda ocp, p, v: ocp.measurement("range", p, noise=1.0, unit="ft"))
    assert labels(solution) == ["K[p] [m/(ft s)]", "K[v] [(m/s)/(ft s)]"]


def test_the_same_unit_leaves_one_per_second():
    solution = moving(lambda ocp, p, v: ocp.measurement("range", p, noise=1.0, unit="m"))
    assert labels(solution) == ["K[p] [1/s]", "K[v] [(m/s)/(m s)]"]


def test_that_is_what_the_numbers_mean():
    """Of a measurement in millimetres, whose noise has 1e6 times the density, the gain is a thousandth."""
    metres = moving(lambda ocp, p, v: ocp.measurement("range", p, noise=1.0, unit="m"))
    millimetres = moving(lambda ocp, p, v: ocp.measurement("range", 1e3 * p, noise=1e6, unit="mm"))
    assert labels(millimetres)[0] == "K[p] [m/(mm s)]"
    (one,), (other,) = values_of(metres.plot("K"), "K[p] [1/s]"), values_of(millimetres.plot("K"), "K[p] [m/(mm s)]")
    np.testing.assert_allclose(other, 1e-3 * one, rtol=1e-9)


def test_without_one_of_the_units_there_is_none():
    solution = moving(lambda ocp, p, v: ocp.measurement("range", p, noise=1.0))
    assert labels(solution) == ["K[p]", "K[v]"]
    assert labels(solution, units={"range": "m"}) == ["K[p] [1/s]", "K[v] [(m/s)/(m s)]"]
    assert labels(moving(lambda ocp, p, v: ocp.measurement("r", p, noise=1.0, unit="m"), unit=""))[0] == "K[p]"


def test_measurements_of_different_units_are_told_apart_by_the_entries():
    def both(ocp, p, v):
        ocp.measurement("range", p, noise=1.0, unit="m")
        ocp.measurement("doppler", v, noise=1.0, unit="Hz")

    figure = moving(both).plot("K")
    assert list(panels(figure)) == ["K[p]", "K[v]"]
    assert entries_of(panels(figure)["K[p]"]) == ["range [1/s]", "doppler [m/(Hz s)]"]


def test_a_vector_that_is_measured_has_one_unit():
    figure = moving(lambda ocp, p, v: ocp.measurement("fix", p, noise=1.0, unit="ft"), size=2).plot("K")
    assert next(iter(panels(figure))) == "K[p[0]] [m/(ft s)]"
    assert entries_of(panels(figure)["K[p[0]] [m/(ft s)]"]) == ["fix[0]", "fix[1]"]


def test_feedback_of_controls_of_different_units():
    ocp = co.Problem(1.0)
    x = ocp.state("x", initial=1.0, variance=1.0, unit="m")
    u, w = ocp.control("u", unit="N"), ocp.control("w", unit="V")
    ocp.dynamics(x, u + w, noise=0.1)
    ocp.measurement("range", x, noise=1.0)
    ocp.minimize_expected(running=u**2 + w**2 + x**2)
    figure = co.solve(ocp, intervals=4, progress=False).plot("C")
    assert list(panels(figure)) == ["C[x]"]
    assert entries_of(panels(figure)["C[x]"]) == ["u [N/m]", "w [V/m]"]


def test_gains_of_phases_have_units_too():
    parts = []
    for k in range(2):
        ocp = co.Problem(1.0)
        x = ocp.state("x", initial=None if k else 0.0, final=1.0 if k else None, variance=None if k else 1.0, unit="m")
        u = ocp.control("u")
        ocp.dynamics(x, u, noise=0.1)
        ocp.measurement("range", x, noise=1.0, unit="ft")
        ocp.estimation_covariance()
        ocp.minimize(running=u**2)
        parts.append(ocp)
    solution = co.solve(co.Phases(parts), intervals=4, progress=False)
    assert list(panels(solution.plot("K"))) == ["K[x] [m/(ft s)]"]

"""Calls of the exported solver: through linked plugins, at the same time, with arguments that mean nothing."""

import re
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from exports import FOLDER, QUICK, package
from problems import unassessed

import covocp as co
from covocp.export import export_c
from covocp.export.compiled import linking
from covocp.models import brachistochrone, unknown_lag

# The meshes are coarse.
pytestmark = [pytest.mark.needs_cc, pytest.mark.filterwarnings("ignore::covocp.CovocpWarning")]

PLUGINS = {"ipopt": "-lipopt", "fatrop": "-lfatrop -lblasfeo"}
FEW = {"intervals": 4, "substeps": 2}
TIGHT = {"ipopt": {"tol": 1e-11, "bound_relax_factor": 0.0}}


@cache
def by_plugin(method):
    """None: the solver of its own."""
    options = {} if method is None else {"method": method}
    return export_c(unknown_lag.problem(weight=10.0), FOLDER / f"by_{method}", **FEW, **options)


@pytest.mark.parametrize("method", PLUGINS)
def test_plugins_are_linked_and_reach_the_same_cost(method):
    made = by_plugin(method)
    readme, header = (made.directory / "README.md").read_text(), (made.directory / f"by_{method}.h").read_text()
    assert f"LIBRARIES = {PLUGINS[method]}" in readme
    assert "only one call may run at a time" in readme
    assert "one call at a time, whatever its workspace" in header
    assert (
        f"PLUGIN_LIBRARIES {' '.join(PLUGINS[method].replace('-l', '').split())}"
        in (made.directory / "CMakeLists.txt").read_text()
    )
    made.build(flags=["-O0"])
    planner = made.python()
    reference = by_plugin(None).reference()
    for arguments in ({}, {"initial_x": 0.4}):
        plan, own = planner(**arguments), reference(**arguments)
        assert planner.status == "OK"
        assert plan["cost"] == pytest.approx(own["cost"], rel=1e-8)
    assert made.check().ok


@pytest.mark.parametrize("method", PLUGINS)
def test_a_plugin_that_is_not_there_is_an_error_that_says_so(method, tmp_path, monkeypatch):
    """On a machine without the wheel's headers and libraries: what is missing, and where to read what is needed."""
    made = by_plugin(method)
    monkeypatch.setattr(linking, "_wheel", lambda: tmp_path)
    include = re.escape(linking.PLUGINS[method].header)
    with pytest.raises(co.ExportError, match=f"(?s)could not be compiled.*({include}|-l{method}).*what is linked"):
        made.build(tool="cc", flags=["-nostdinc++"])


def test_fatrop_keeps_bounds_that_it_would_widen():
    """Brachistochrone: bounds of the control and of the free duration."""
    made = export_c(brachistochrone.problem(), FOLDER / "fatrop_bounds", intervals=10, substeps=2, method="fatrop")
    solution = co.solve(brachistochrone.problem(), intervals=10, substeps=2, progress=False, plugin_options=TIGHT)
    assert made.reference()()["cost"] == pytest.approx(solution.cost, rel=1e-8)


def test_self_contained_solvers_may_run_at_the_same_time():
    """Bit for bit what they plan one after the other; nothing static is written to."""
    made = package("planner")
    source = (made.directory / "planner_casadi.c").read_text()
    assert not re.search(r"= casadi_f\d+_checkout\(\)|^ *casadi_f\d+_release\(|^static struct", source, re.MULTILINE)
    assert "of calls at the same time each has its own" in (made.directory / "planner.h").read_text()
    starts = np.linspace(-0.4, 0.4, 8)

    def plans(planner):
        return [planner(initial_x=x)["variables"] for x in starts for _ in range(4)]

    expected = plans(made.python())
    with ThreadPoolExecutor(4) as threads:
        for found in threads.map(plans, [made.python() for _ in range(4)]):
            np.testing.assert_array_equal(found, expected)


def test_arguments_that_are_not_finite_return_the_plan_of_the_export():
    planner, ports = package("planner").python(), package("planner").laws[0].arguments
    usual = planner()
    defaults = package("planner").laws[0].defaults
    places = np.cumsum([0, *(port.size for port in ports)])
    for port, (first, last) in zip(ports, pairwise(places), strict=True):
        for value in (np.nan, np.inf, -np.inf):
            argument = defaults[first:last].copy()
            argument[-1] = value
            plan = planner(**{port.name: argument.reshape(port.shape)})
            assert planner.status == plan.pop("status") == "ARGUMENT_NOT_FINITE"
            for result, entry in plan.items():
                np.testing.assert_array_equal(entry, usual[result])


@pytest.mark.parametrize("arguments", [{"initial_x": 1e200}, {"weight": 1e300}, {"b": 1e200}, {"duration": 1e300}])
def test_arguments_that_overflow_return_the_plan_of_the_export(arguments):
    planner = package("planner").python()
    usual, plan = planner(), planner(**arguments)
    assert planner.status == "FAILED"
    np.testing.assert_array_equal(plan["u"], usual["u"])


def test_a_plan_that_is_far_from_all_is_finite_and_not_called_solved():
    """A mean of 1e10 with a deviation of one: the iterations do not end, or overflow."""
    planner = package("planner").python()
    plan = planner(b=1e10)
    assert planner.status in ("NOT_CONVERGED", "FAILED")
    assert all(np.isfinite(entry).all() for name, entry in plan.items() if name != "status")


def test_a_plan_backwards_in_time_is_none():
    """x' = u, J = x(T) + integral of u^2/2 = 1 - T/2, here zero: stationary for every T, but a plan for T > 0 only."""
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", initial=1.0), ocp.control("u")
    ocp.dynamics(x, u)
    ocp.minimize(running=0.5 * u**2, terminal=x)
    planner = export_c(ocp, FOLDER / "backwards", intervals=4, substeps=1).reference()
    assert planner(duration=3.0)["cost"] == pytest.approx(1.0 - 3.0 / 2.0, rel=1e-9)
    assert planner.status == "OK"
    for duration in (0.0, -0.5):
        planner(duration=duration)
        assert planner.status != "OK"


@pytest.mark.parametrize(
    ("arguments", "named", "words"),
    [
        ((), {"x": 0.2}, r"there is no argument 'x'.*received: x=0.2\n.*'initial_x' is meant"),
        ((), {"initial_X": 0.2}, r"no argument 'initial_X'.*perhaps 'initial_x' is meant"),
        ((), {"weigth": 3.0}, r"no argument 'weigth'.*perhaps 'weight' is meant"),
        ((), {"altitude": 3.0}, r"no argument 'altitude'.*received: altitude=3.0\n.*leave 'altitude' out"),
        ((), {"initial_x": [1.0, 2.0]}, r"received: initial_x \(2,\)\n.*give 'initial_x' in its shape"),
        ((), {"initial_x": "here"}, r"received: initial_x='here'\n.*give numbers"),
        ((0.1,), {"initial_x": 0.1}, r"'initial_x' by its place and by its name"),
        ((0.0,) * 9, {}, r"received: 9 values\n.*give 6 at most"),
    ],
)
def test_arguments_that_are_none_are_named_with_those_that_there_are(arguments, named, words):
    listed = r"expected: initial_x \(\), initial_E \(2, 2\), weight \(\), b \(\), duration \(\), guess "
    with pytest.raises(co.ExportError, match=rf"(?s)arguments of 'solve' do not fit.*{words}") as error:
        package("planner").reference().solve(*arguments, **named)
    assert re.search(listed, str(error.value))
    assert "received: 0 values" not in str(error.value)


def test_a_plan_carries_its_status():
    planner = package("planner").python()
    assert planner.solve(initial_x=0.1)["status"] == "OK"
    assert planner.solve(initial_x=np.nan)["status"] == planner.status == "ARGUMENT_NOT_FINITE"


def test_a_plan_for_a_feedback_says_that_it_has_no_gains(tmp_path):
    made = export_c(unknown_lag.steering(parameter_variance=0.05), tmp_path / "steer", intervals=8, substeps=1)
    plan = made.reference()()
    assert set(plan) == {
        "time", "u", "x", "cost", "infeasibility", "stationarity", "variables", "status",
    }  # fmt: skip
    text = (made.directory / "README.md").read_text()
    assert "nominal only, without gains" in text
    assert "without gains" not in (package("planner").directory / "README.md").read_text()
    assert "initial_<state>" in type(made).python.__doc__


def test_names_of_the_plan_are_not_those_of_its_status(tmp_path):
    """A control called status has another name in C, where the return value has this one."""
    ocp = co.Problem(duration=1.0)
    x, u = ocp.state("x", initial=0.0, final=1.0), ocp.control("status")
    ocp.dynamics(x, u)
    ocp.minimize(running=u**2)
    plan = export_c(ocp, tmp_path / "pk", intervals=4, substeps=1).reference()()
    assert plan["status"] == "OK"
    np.testing.assert_allclose(plan["control_status"], 1.0, rtol=1e-8)


@pytest.mark.parametrize(
    ("option", "remedy"), [({"interval": 9}, "perhaps 'intervals' is meant"), ({"limits": "bounds"}, "leave it out")]
)
def test_options_that_a_solver_has_not_are_refused(tmp_path, option, remedy):
    with pytest.raises(co.ExportError, match=rf"(?s)no option '{next(iter(option))}' for a problem.*{remedy}"):
        export_c(unknown_lag.problem(), tmp_path / "pk", **option)


def pulled(matrix) -> co.Problem:
    """Two states with a matrix parameter that is not symmetric."""
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", 2, initial=[1.0, 0.0], variance=0.1), ocp.control("u")
    b = ocp.unknown("b", mean=1.0, variance=0.2)
    ocp.dynamics(x, ocp.parameter("M", matrix) @ x + ca.vertcat(0, b * u))
    ocp.measurement("y", x[0], noise=0.05)
    E = ocp.estimation_covariance()
    ocp.minimize(running=u**2, terminal=ca.dot(x, x) + E[b, b])
    return ocp


def test_a_matrix_parameter_is_given_as_it_is():
    """Not its transpose, by default or by name, in Python and in C; of another shape it is refused."""
    matrix = np.array([[0.0, 1.0], [-2.0, -0.3]])
    made = export_c(pulled(matrix), FOLDER / "pulled", intervals=8, substeps=2)
    made.build(flags=QUICK)
    assert made.check().ok
    changed = np.array([[0.1, 0.7], [-1.5, -0.2]])
    known, other = (unassessed(pulled(meant), intervals=8, substeps=2).cost for meant in (matrix, changed))
    for planner in (made.reference(), made.python()):
        for given, cost in (
            ({}, known),
            ({"M": matrix}, known),
            ({"M": changed}, other),
            ({"M": changed.ravel()}, other),
        ):
            assert planner(**given)["cost"] == pytest.approx(cost, rel=1e-7)
        with pytest.raises(co.ExportError, match="give 'M' in its shape"):
            planner(M=np.zeros((1, 4)))
    assert "2 by 2, row by row" in (made.directory / "pulled.h").read_text()


def test_threads_that_share_a_compiled_planner_get_their_own_plans():
    planner = package("planner").python()
    starts = np.linspace(0.2, 0.9, 4)
    known = [planner(initial_x=start)["cost"] for start in starts]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda k: (k, planner(initial_x=starts[k % 4])), range(40)))
    for k, plan in found:
        assert plan["status"] == "OK"
        assert plan["cost"] == known[k % 4]


def test_one_segment_compiles_without_a_warning():
    """Code in which newer compilers see an address of a local array that outlives it."""
    made = export_c(unknown_lag.problem(), FOLDER / "single", intervals=12, substeps=2, segments=1)
    made.build(flags=["-Werror"])
    assert made.check().ok


def test_residuals_that_are_rounding_are_no_deviation():
    """Of a stiff plant CasADi's C code of Ipopt leaves another slope, of 1e-9, at the same plan."""
    ocp = co.Problem(duration=2.0)
    x, u = ocp.state("x", 2, initial=[0.3, 0.0], variance=0.1), ocp.control("u", guess=-0.2)
    b = ocp.unknown("b", mean=1.0, variance=0.3)
    ocp.dynamics(x, ca.vertcat(2.0 * x[0] + b * x[1], -200.0 * (x[1] - u)), noise=[0.01, 0.1])
    ocp.measurement("y", x[0], noise=0.01)
    E = ocp.estimation_covariance()
    ocp.minimize(running=x[0] ** 2 + 0.1 * u**2 + 0.2 * E[x[0], x[0]], terminal=x[0] ** 2 + E[b, b])
    made = export_c(ocp, FOLDER / "stiff", intervals=6, substeps=4, method="ipopt")
    made.build(flags=["-O0"])
    assert made.check().ok


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (5, "a dict of options of the plugin by name"),
        ({"hessian_approximation": "nonsense"}, "'exact' or 'limited-memory'"),
        ({"ipopt": 5}, "Unknown option: ipopt"),
    ],
)
def test_wrong_options_of_the_plugin_are_refused_by_name(given, words, tmp_path):
    with pytest.raises(co.ExportError, match=words):
        export_c(unknown_lag.problem(), tmp_path / "lag", **FEW, plugin_options=given)


def parametric(*, expected=False, shared=False):
    """The lag whose first state and variance are parameters; shared: the target is a multiple of that state."""
    ocp = co.Problem(duration=2.0, name="parametric")
    x0, p0 = ocp.parameter("x0", 0.5), ocp.parameter("p0", 0.3)
    x = ocp.state("x", initial=x0, final=0.1 * x0 if shared else 0.0, variance=p0)
    b, u = ocp.unknown("b", mean=1.0, variance=0.5), ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=0.1)
    ocp.measurement("position", x, noise=0.2)
    if expected:
        ocp.minimize_expected(running=0.5 * u**2, terminal_weight={x: 1.0})
    else:
        E = ocp.estimation_covariance()
        ocp.minimize(running=0.5 * u**2, terminal=E[b, b] + E[x, x])
    return ocp


@pytest.mark.parametrize("expected", [False, True])
def test_a_parameter_of_the_start_alone_is_no_argument(expected):
    """Nothing is an argument that does nothing; the start in its place plans what `Solver` plans for the parameter."""
    name = f"parametric_{expected}"
    made = export_c(parametric(expected=expected), FOLDER / name, **FEW)
    ports = {port.name: port for port in made.laws[0].arguments}
    assert list(ports) == ["initial_x", "initial_E", "b", "duration", "guess"]
    assert "in place of what 'x0' would give" in ports["initial_x"].about
    assert "in place of what 'p0' would give" in ports["initial_E"].about
    planner = made.reference()
    with pytest.raises(co.ExportError, match="only a start depends on 'x0': give initial_x"):
        planner(x0=2.0)
    plan = planner(initial_x=2.0, initial_E=np.diag([1.0, 0.5]))
    nodes = plan["time"].ravel() / plan["time"].max()  # of the export: in Python they follow the prior
    known = co.Solver(parametric(expected=expected), **FEW, grid=nodes).solve(
        {"x0": 2.0, "p0": 1.0}, progress=False, assess=False
    )
    assert planner.status == "OK"
    assert plan["cost"] == pytest.approx(known.cost, rel=1e-6)


def test_a_parameter_of_the_start_and_of_something_else_is_an_argument():
    made = export_c(parametric(shared=True), FOLDER / "parametric_shared", **FEW)
    names = [port.name for port in made.laws[0].arguments]
    assert names == ["initial_x", "initial_E", "x0", "b", "duration", "guess"]
    plan = made.reference()(initial_x=1.0, x0=2.0)
    assert (float(plan["x"].ravel()[0]), float(plan["x"].ravel()[-1])) == pytest.approx((1.0, 0.2), abs=1e-7)


def test_a_saddle_is_called_solved_and_the_texts_say_so():
    """x' = -b x + u from x = 0: at u = 0 nothing is learnt about b, E_bb(T) stays 5; moving either way is better."""
    ocp = co.Problem(duration=4.0)
    x, b, u = ocp.state("x", initial=0.0), ocp.unknown("b", mean=1.0, variance=5.0), ocp.control("u")
    ocp.dynamics(x, -b * x + u, noise=0.0)
    ocp.measurement("position", x, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=0.1 * u**2, terminal=10.0 * E[b, b])
    made = export_c(ocp, FOLDER / "saddle", intervals=8)
    planner = made.reference()
    plan = planner()
    still = planner(guess=0.0 * plan["variables"])
    assert plan["cost"] < 5.0
    assert (still["status"], still["cost"]) == ("OK", pytest.approx(50.0))
    for text in ("saddle.h", "README.md"):
        words = " ".join((made.directory / text).read_text().replace("\n *", " ").split())
        assert "A saddle fulfils them too: start from a plan, not from a symmetric guess" in words
        assert "how well the first-order conditions of a minimum hold" in words

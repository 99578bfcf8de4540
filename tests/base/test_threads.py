"""Several threads at once: the same numbers as one after the other, and nothing lost of what the process prints.

They run in a process of their own, since what goes wrong ends the process or holds it for ever.
"""

import subprocess
import sys

import pytest

COMMON = """
import concurrent.futures, sys, tempfile, warnings
import casadi as ca
import numpy as np
import covocp as co

warnings.simplefilter("ignore", co.CovocpWarning)  # four intervals are few

def stated():
    ocp = co.Problem(2.0)
    a = ocp.parameter("a", 1.0)
    x = ocp.state("x", initial=1.0, variance=0.5)
    u = ocp.control("u")
    ocp.dynamics(x, u - ca.sin(x), noise=0.1)
    ocp.measurement("m", x, noise=0.1)
    E = ocp.estimation_covariance()
    ocp.minimize(running=a * u**2 + x**2, terminal=E[x, x] * x**2)
    return ocp

MESH = {"intervals": 4, "substeps": 2, "progress": False}
PARAMETERS = [{"a": 1.0 + 0.1 * k} for k in range(8)]
common = stated()
solver = co.Solver(common, intervals=4, substeps=2)
expected = [solver.solve(given, progress=False).cost for given in PARAMETERS]
solution = solver.solve(progress=False)

def same(cost, k):
    assert abs(cost - expected[k]) < 1e-7 * expected[k], (cost, expected[k])

def in_threads(work, count):
    streams = sys.stdout, sys.stderr
    with concurrent.futures.ThreadPoolExecutor(4) as threads:
        list(threads.map(work, [i % 8 for i in range(count)]))
    assert (sys.stdout, sys.stderr) == streams
"""
WAYS = {
    "a solver of each": """
in_threads(lambda k: same(co.solve(stated(), parameters=PARAMETERS[k], **MESH).cost, k), COUNT)
""",
    "one problem": "in_threads(lambda k: same(co.solve(common, parameters=PARAMETERS[k], **MESH).cost, k), COUNT)",
    "one solver": "in_threads(lambda k: same(solver.solve(PARAMETERS[k], progress=False).cost, k), COUNT)",
    "one solution": """
fresh = [solver.solve(given, progress=False) for given in PARAMETERS]
known = co.solve(common, **MESH)
def work(i):
    own = fresh[i]
    assert own.optimality.stationarity < 1e-4
    assert own.costate("x")[0] == own.costates.state[0, 0]
    np.testing.assert_allclose(known[common.states[0].symbol * i], i * known["x"])
    same(co.evaluate(own).cost, i)
in_threads(work, COUNT)
""",
    "the gradient method": """
cheap = {"intervals": 4, "progress": False, "max_iterations": 3, "allow_failure": True}
reference = co.solve(common, "gradient", **cheap).cost
def work(i):
    assert co.solve(common, "gradient", **cheap).cost == reference
in_threads(work, max(2, COUNT // 4))
""",
    "plugins and files": """
def work(i):
    with tempfile.TemporaryDirectory() as folder:
        z = ca.SX.sym("z")
        co.export_c(ca.Function("f", [z], [z**2 + i]), folder + "/square")
        assert co.load(solution.save(folder + "/one.npz")).cost == solution.cost
    found = co.solve(common, plugin="sqpmethod", **MESH)
    assert abs(found.cost - expected[0]) < 1e-5 * expected[0]
in_threads(work, max(2, COUNT // 4))
""",
    "a law that solves, on an executor of threads": """
linear = co.Problem(1.0)
x, u = linear.state("x", initial=0.0, variance=1.0), linear.control("u")
linear.dynamics(x, u - x, noise=0.1)
linear.measurement("m", x, noise=0.1)
linear.minimize_expected(running=u**2, terminal_weight={x: 1.0})
design = co.solve(linear, **MESH)
class Law:
    period = 1.0
    def step(self, measurement, time):
        return np.array([solution.at(time)["x"] * solver.solve(progress=False).converged])
with concurrent.futures.ThreadPoolExecutor(2) as threads:
    runs = co.simulate(design, COUNT, seed=1, law=Law(), executor=threads, step=0.1, batch=64, progress=False)
assert runs.runs == COUNT
""",
}


def check(ways, count):
    script = f"COUNT = {count}\n{COMMON}" + "\n".join(ways) + "\nprint('all right')"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "all right\n", "")


def test_threads_agree_and_end():
    check(WAYS.values(), 4)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_many_calls_in_threads_agree_and_end(way):
    check([WAYS[way]], 16)

"""Move a lag so that its time constant is learnt
==============================================

The script of the README: the control first pushes to learn the unknown constant, then steers to the target.
"""

import covocp as co

ocp = co.Problem(duration=10.0, name="first-order lag, unknown time constant")
x = ocp.state("x", initial=0.0, final=1.0, variance=1.0)  # nominal start, target, variance of the initial estimate
b = ocp.unknown("b", mean=1.0, variance=5.0)  # constant, unknown: estimated together with the state
u = ocp.control("u")
ocp.dynamics(x, -b * x + u, noise=1.0)  # dx/dt = ... + n,   <n n'> = 1.0 delta
ocp.measurement("position", x, noise=1.0)  # m = x + v,         <v v'> = 1.0 delta
E = ocp.estimation_covariance()  # Kalman-Bucy covariance of (x, b): a symmetric matrix state

ocp.minimize(running=0.5 * u**2, terminal=10.0 * E[b, b])

solution = co.solve(ocp, intervals=100)  # multiple shooting, Ipopt
print(solution)  # cost by term, terminal values, optimality residual, time
solution.plot(path="first_order_lag.png")
print(co.compare(ocp, methods=["ipopt", "gradient"], intervals=100))
print(co.certify(solution))

"""Settings and functions of the NLP plugins of CasADi that are written out as C."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from covocp.transcription.nlp import NLP, QUIET
from covocp.transcription.separable import FOR_OWN, slopes

# What the solvers are asked for, in the units of the NLP. Interior-point methods end with a barrier of a tenth of what
# they are asked for, which the cost has in it for each bound that is reached.
ASKED, ASKED_INTERIOR = 1e-8, 1e-10
MAX_ITERATIONS = 200
# Multipliers below this are rounding: taken for reached, their bounds make the first active set of the QP dependent.
INACTIVE = 1e-9
# Plugins that take functions of slopes as they are.
TAKING = ("sqpmethod", "ipopt")


def hessians(method: str, own: Mapping[str, Any], *, alone: bool) -> list[bool]:
    """Whether the Hessian is exact, in the order in which that is tried; `alone`: matrices pass along the nominal."""
    inner = own.get(method)
    inner = inner if isinstance(inner, Mapping) else {}
    asked = own.get("hessian_approximation", inner.get("hessian_approximation"))
    if asked is not None or method == "fatrop":
        return [asked != "limited-memory"]
    return [False] if alone else [True, False]


def plugin_settings(method: str, exact: bool, own: Mapping[str, Any], share: float = 1.0) -> dict[str, Any]:
    """Settings of the plugin; `share`: of the unit of the cost in its scale, by which slopes must be smaller."""
    settings: dict[str, Any] = dict(QUIET)
    if method == "sqpmethod":
        settings |= {"qpsol": "qrqp", "max_iter": MAX_ITERATIONS, "tol_du": share * ASKED, "tol_pr": ASKED}
        settings |= {"print_header": False, "print_iteration": False, "print_status": False, "min_step_size": 1e-14}
        settings["qpsol_options"] = {
            "print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False,
            "min_lam": INACTIVE,
        }  # fmt: skip
        settings["hessian_approximation"] = "exact" if exact else "limited-memory"
    elif method == "ipopt":
        # Bounds are those of the problem: widened by Ipopt's 1e-8 they lower the cost of Bryson-Denham by 9e-8.
        settings["ipopt"] = {"print_level": 0, "sb": "yes", "max_iter": MAX_ITERATIONS}
        settings["ipopt"] |= {"tol": ASKED_INTERIOR, "bound_relax_factor": 0.0}
        if not exact:
            settings["ipopt"] |= {"hessian_approximation": "limited-memory", "limited_memory_max_history": 20}
    elif method == "fatrop":
        settings["fatrop"] = {"print_level": 0, "tolerance": ASKED_INTERIOR, "max_iter": MAX_ITERATIONS}
    for key, value in own.items():
        settings[key] = {**settings.get(key, {}), **value} if isinstance(value, Mapping) else value
    return settings


def plugin_functions(nlp: NLP, method: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The slopes of the NLP as options of a plugin, where CasADi does not make them."""
    if nlp.gradient is None:
        taken = nlp.pieces and method in TAKING and not settings.keys() & set(FOR_OWN)
        return _by_pieces(nlp, method, settings) if taken else {}
    given, names = [nlp.w, nlp.p], ["x", "p"]
    (f, gradient), (g, jacobian) = nlp.gradient, (nlp.g, nlp.jacobian)
    if method == "sqpmethod":
        outputs = ["f", "grad_f_x", "g", "jac_g_x"]
        own = ca.Function("nlp_jac_fg", given, [f, gradient, g, jacobian], names, outputs)
        return {"jac_fg": own, "no_nlp_grad": True}
    return {
        "no_nlp_grad": True,
        "grad_f": ca.Function("nlp_grad_f", given, [f, gradient], names, ["f", "grad_f_x"]),
        "jac_g": ca.Function("nlp_jac_g", given, [g, jacobian], names, ["g", "jac_g_x"]),
    }


def _by_pieces(nlp: NLP, method: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The same, piece by piece; second slopes where the Hessian is exact."""
    asked = [settings, *(value for value in settings.values() if isinstance(value, Mapping))]
    exact = all(own.get("hessian_approximation") != "limited-memory" for own in asked)
    found: dict[str, Any] = slopes(nlp.pieces, nlp.w, nlp.p, nlp.g.shape[0], second=exact)
    if method == "sqpmethod":
        first = [found.pop(name).call([nlp.w, nlp.p]) for name in ("grad_f", "jac_g")]
        outputs = ["f", "grad_f_x", "g", "jac_g_x"]
        found["jac_fg"] = ca.Function("nlp_jac_fg", [nlp.w, nlp.p], [*first[0], *first[1]], ["x", "p"], outputs)
    if method == "sqpmethod" and exact:
        given = found["hess_lag"].mx_in()
        whole = ca.triu2symm(found["hess_lag"](*given))
        found["hess_lag"] = ca.Function("nlp_hess_l", given, [whole], ["x", "p", "lam_f", "lam_g"], ["hess_gamma_x_x"])
    by_parameters = any(name.startswith("calc_") and settings[name] for name in settings)
    return found if by_parameters else found | {"no_nlp_grad": True}


def refused_option(message: str) -> str:
    """The line of CasADi's message that names the option; behind an unknown one it lists some that it has."""
    lines = message.strip().splitlines()
    unknown = [line.rpartition(": Unknown")[2] for line in lines if ": Unknown" in line]
    return f"Unknown{unknown[0]}" if unknown else lines[-1]

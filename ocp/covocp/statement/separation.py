"""Whether filter and feedback of an expected cost are the same along every nominal, and whether that is a simple one.

Where slopes, noises and weights depend on neither state nor control, and the time is given, E and S are the same along
every nominal: the expected cost is the deterministic one and a constant, and has its optimum (certainty equivalence).
Where the rates and conditions are affine besides, and the cost is quadratic, the deterministic problem is a quadratic
program.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca

from covocp.statement.interval import model_symbols
from covocp.statement.statement import Statement

# Statements that are remembered.
KEPT = 16


@lru_cache(maxsize=KEPT)
def separates(statement: Statement) -> bool:
    """Whether E and S, and what they cost, are the same along every nominal."""
    loop = statement.loop
    if loop is None or loop.by_parts is None or statement.coupled or statement.duration.free:
        return False
    if statement.tied is not None or statement.decisions or statement.matrix_end is None:
        return False
    if len(statement.matrices) != len(statement.behind) + 1 or not statement.estimated:
        return False  # others have costs of their own
    samples = () if statement.samples is None else (statement.samples.measurement,)
    alike = not any(statement.varies(i) for i in range(len(statement.matrices)))
    alike = alike and not _depends(statement.matrix_end, range(1), range(statement.matrix_end.n_out()))
    alike = alike and not _depends(loop.expansion, range(2), range(loop.expansion.n_out()))
    return alike and not any(_depends(one, range(2), (1, 2)) for one in samples)


@lru_cache(maxsize=KEPT)
def quadratic(statement: Statement) -> bool:
    """Whether the deterministic problem of an expected cost has affine rates and conditions and a quadratic cost."""
    loop = statement.loop
    if loop is None or statement.nominal is None or statement.duration.free or statement.decisions:
        return False
    _, _, e, time, duration, p = model_symbols(statement)
    symbolic: Any = statement.symbolic
    z = symbolic.sym("z", statement.nx + statement.nu)
    x, u = z[: statement.nx], z[statement.nx :]
    rate, running = statement.nominal(x, u, time, duration, p)[0], loop.running(x, u, time, duration, p)
    terminal = loop.terminal(x, duration, p)[0]
    conditions = [one.function(x, u, e, time, duration, p) for one in statement.conditions if one.size]
    slopes = [ca.gradient(value, z) for value in (running, terminal)]
    return not any(any(ca.which_depends(value, z, 2)) for value in (rate, *conditions, *slopes))


def _depends(function: ca.Function, inputs: range, outputs: range | tuple[int, ...]) -> bool:
    return any(function.jac_sparsity(k, i).nnz() for k in outputs for i in inputs)

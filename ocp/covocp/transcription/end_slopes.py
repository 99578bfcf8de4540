"""How controls move the states in which the nominal ends, by the compiled library: no expression is made of the run."""

from __future__ import annotations

import numpy as np

from covocp.base.matrices import Array
from covocp.passage.columns import Prepared, derivative_in_columns, numbers_in_turn
from covocp.statement.statement import Statement
from covocp.transcription.mesh import Mesh
from covocp.transcription.numbers import by_control_values, columns_of_parts
from covocp.transcription.steps import nominal_interval


def end_slopes(
    statement: Statement,
    mesh: Mesh,
    start: Array,
    u: Array,
    duration: float,
    parameters: Array,
    rows: tuple[int, ...],
) -> tuple[Array, Array] | None:
    """Some states at the end of one run of the nominal, and their slopes by the control values.

    Args:
        statement: a problem whose nominal runs alone.
        mesh: of it.
        start: state where it begins, (nx,).
        u: control values, (nodes, nu).
        duration: T [s].
        parameters: of the statement.
        rows: the states.

    Returns:
        Their values (rows,), and slopes by the control values one node after the other, (rows, nodes nu); None where
        the library cannot take the model, or steps are implicit.
    """
    st, parts = statement, mesh.substeps
    if mesh.step == "rodas":
        return None
    advance, columns = nominal_interval(st, 1, mesh.step), columns_of_parts(mesh, parts, u.T, duration, parameters)
    ahead, count = derivative_in_columns(st, advance, "forward"), mesh.intervals * parts
    found = None if ahead is None else numbers_in_turn(st, advance, start[:, None], columns, count)
    if ahead is None or found is None:
        return None
    before = np.column_stack([start, found[0][:, :-1]])
    values = [np.asfortranarray(value, dtype=float) for value in (before, *columns)]
    moved = [np.zeros_like(value, order="F") for value in values[:3]]  # states, controls at both ends of the steps
    run = Prepared(ahead, [*values, *[None] * len(found), *moved, *[None] * (len(columns) - 2)], count)
    slopes = []
    for own in moved:
        slopes.append(np.zeros((count, st.nx, own.shape[0])))
        for i in range(own.shape[0]):
            own[i] = 1.0
            run.run()
            own[i] = 0.0
            if run.found[0].size:
                slopes[-1][:, :, i] = run.found[0].T
    weights = np.empty((count, len(rows), st.nx))  # of the states after each step
    weights[-1] = np.eye(st.nx)[list(rows)]
    for k in range(count - 1, 0, -1):
        weights[k - 1] = weights[k] @ slopes[0][k]
    begin, end = (np.moveaxis(weights @ by_u, 0, 2).reshape(-1, count) for by_u in slopes[1:])
    by_u = by_control_values(mesh, begin, end).reshape(-1, len(rows), st.nu).transpose(1, 0, 2)
    return found[0][list(rows), -1], by_u.reshape(len(rows), -1)

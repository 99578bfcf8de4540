"""Solutions as xarray datasets."""

from __future__ import annotations

from typing import Any

import numpy as np

from covocp.base.errors import ExportError
from covocp.base.matrices import Array
from covocp.blocks.rotation_chart import rotation_vectors
from covocp.solution.solution import Solution


def to_xarray(solution: Solution) -> Any:
    """The solution as an xarray.Dataset over the time of the nodes.

    States, controls, matrices, constants, decisions, and integrals up to each node, under their names; their costates
    as "costate_<name>", standard deviations of the estimates as "deviation_<name>". The entries of vectors run along
    "<name>_entry", the rows and columns of matrices, labelled by what they belong to, along "<name>_row" and
    "<name>_column". An attitude also has its rotation vector as "vector_<name>" and the length of that as
    "angle_<name>" [rad]; its deviation is that of its three errors.

    Args:
        solution: what to convert.

    Returns:
        The dataset; attributes: name, method, status, converged, cost and its terms, duration, control, mesh_error.

    Raises:
        ExportError: xarray is not installed.
    """
    try:
        import xarray
    except ImportError as error:
        raise ExportError(
            "A solution cannot be converted to xarray: xarray is not installed.",
            expected="the package xarray",
            received=str(error),
            remedy="pip install 'covocp[xarray]'",
        ) from error
    variables: dict[str, tuple[tuple[str, ...], Array]] = {}
    coordinates: dict[str, Any] = {"time": ("time", solution.t, {"units": "s"})}
    estimated = any(block.estimation for block in solution.blocks)
    for block in solution.blocks:
        name, constant = block.name, block.kind in ("unknown", "parameter") or block.role == "decision"
        dimensions: tuple[str, ...] = () if block.size == 1 else (f"{name}_entry",)
        if block.kind == "matrix" and block.role == "moving":
            dimensions = (f"{name}_row", f"{name}_column")
            coordinates |= {dimension: list(block.labels) for dimension in dimensions}
        values = solution.values[name]
        if block.role == "integral":
            values = values.reshape(solution.t.size)
        variables[name] = (dimensions, values[0]) if constant else (("time", *dimensions), values)
        if block.kind in ("state", "matrix") and block.role == "moving":
            variables[f"costate_{name}"] = (("time", *dimensions), solution.costate(name))
        if block.tangent:
            vectors, dimensions = rotation_vectors(values), (f"{name}_axis",)
            coordinates[f"{name}_axis"] = ["x", "y", "z"]
            variables[f"vector_{name}"] = (("time", *dimensions), vectors)
            variables[f"angle_{name}"] = (("time",), np.linalg.norm(vectors, axis=1))
        if estimated and block.kind in ("state", "unknown") and block.role == "moving":
            variables[f"deviation_{name}"] = (("time", *dimensions), solution.deviation(name))
    return xarray.Dataset(variables, coords=coordinates, attrs=_attributes(solution))


def _attributes(solution: Solution) -> dict[str, Any]:
    """Of the dataset; of types that every file format of xarray can hold."""
    terms = {f"cost_{name}": float(value) for name, value in solution.cost_terms.items()}
    return {
        "name": solution.name,
        "method": solution.method,
        "status": solution.status,
        "converged": int(solution.converged),
        "cost": solution.cost,
        **terms,
        "duration": float(solution.duration),
        "control": solution.mesh.control,
        "mesh_error": float(solution.mesh_error),
    }

"""Kalman filters: continuous, discrete, extended, steady, of square roots; recursive least squares."""

from __future__ import annotations

from covocp.blocks.bucy import discretise as discretise
from covocp.blocks.bucy import rate as rate
from covocp.blocks.steady import Filter as Filter
from covocp.blocks.steady import steady_state as steady_state
from covocp.blocks.updates import joseph as joseph
from covocp.blocks.updates import predict as predict
from covocp.blocks.updates import update as update

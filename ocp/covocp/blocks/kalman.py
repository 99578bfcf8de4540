"""Kalman filters: continuous, discrete, extended, steady, of square roots; recursive least squares."""

from __future__ import annotations

from covocp.blocks.bucy import discretise as discretise
from covocp.blocks.bucy import rate as rate
from covocp.blocks.extended import extended as extended
from covocp.blocks.extended import extended_rate as extended_rate
from covocp.blocks.least_squares import diffuse_start as diffuse_start
from covocp.blocks.least_squares import least_squares_start as least_squares_start
from covocp.blocks.least_squares import recursive_least_squares as recursive_least_squares
from covocp.blocks.square_root import factor as factor
from covocp.blocks.square_root import predict_factor as predict_factor
from covocp.blocks.square_root import update_factor as update_factor
from covocp.blocks.steady import Filter as Filter
from covocp.blocks.steady import steady_state as steady_state
from covocp.blocks.updates import joseph as joseph
from covocp.blocks.updates import predict as predict
from covocp.blocks.updates import update as update

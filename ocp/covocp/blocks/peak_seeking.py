"""Peak seeking: gradient and Hessian of an unknown function by a Kalman filter, and steps to its extremum."""

from __future__ import annotations

from covocp.blocks.excitation import circle as circle
from covocp.blocks.excitation import ramp as ramp
from covocp.blocks.excitation import sine as sine
from covocp.blocks.quadratic import Parameters as Parameters
from covocp.blocks.quadratic import gradient as gradient
from covocp.blocks.quadratic import hessian as hessian
from covocp.blocks.quadratic import parameters as parameters
from covocp.blocks.quadratic import regressor as regressor
from covocp.blocks.quadratic import transport as transport
from covocp.blocks.seeker import Estimate as Estimate
from covocp.blocks.seeker import Seeker as Seeker
from covocp.blocks.seeker import seeker as seeker
from covocp.blocks.seeker import with_changes as with_changes

"""Riccati and Lyapunov equations, regulators by them, and what they prove about a closed loop."""

from __future__ import annotations

from covocp.blocks.algebraic import continuous as continuous
from covocp.blocks.algebraic import discrete as discrete
from covocp.blocks.algebraic import lyapunov as lyapunov
from covocp.blocks.algebraic import undetectable as undetectable
from covocp.blocks.algebraic import unstabilisable as unstabilisable
from covocp.blocks.duality import Control as Control
from covocp.blocks.duality import Estimation as Estimation
from covocp.blocks.duality import dual as dual
from covocp.blocks.regulators import Augmented as Augmented
from covocp.blocks.regulators import GaussianRegulator as GaussianRegulator
from covocp.blocks.regulators import ReferenceInput as ReferenceInput
from covocp.blocks.regulators import Regulator as Regulator
from covocp.blocks.regulators import integral_states as integral_states
from covocp.blocks.regulators import lqg as lqg
from covocp.blocks.regulators import lqr as lqr
from covocp.blocks.regulators import rate as rate
from covocp.blocks.regulators import recursion as recursion
from covocp.blocks.regulators import reference_input as reference_input
from covocp.blocks.stability import LyapunovCertificate as LyapunovCertificate
from covocp.blocks.stability import lyapunov_certificate as lyapunov_certificate

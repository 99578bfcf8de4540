"""Rotations: exponential and logarithm, Jacobians, quaternions, steps that stay rotations, gradients in body axes."""

from __future__ import annotations

from covocp.blocks.quaternions import from_quaternion as from_quaternion
from covocp.blocks.quaternions import quaternion_product as quaternion_product
from covocp.blocks.quaternions import quaternion_step as quaternion_step
from covocp.blocks.quaternions import to_quaternion as to_quaternion
from covocp.blocks.rotation_steps import body_gradient as body_gradient
from covocp.blocks.rotation_steps import increment as increment
from covocp.blocks.rotation_steps import runge_kutta_step as runge_kutta_step
from covocp.blocks.rotations import antisymmetric_part as antisymmetric_part
from covocp.blocks.rotations import cross as cross
from covocp.blocks.rotations import exp as exp
from covocp.blocks.rotations import inverse_left_jacobian as inverse_left_jacobian
from covocp.blocks.rotations import is_rotation as is_rotation
from covocp.blocks.rotations import left_jacobian as left_jacobian
from covocp.blocks.rotations import log as log
from covocp.blocks.rotations import principal as principal
from covocp.blocks.rotations import project as project
from covocp.blocks.rotations import vee as vee

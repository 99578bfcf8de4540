"""Attitude seeking: the gradient of an unknown function of the attitude, and guidance to its peak between zones."""

from __future__ import annotations

from covocp.blocks.attitude_filter import GradientEstimate as GradientEstimate
from covocp.blocks.attitude_filter import turn_between as turn_between
from covocp.blocks.attitude_guidance import AttitudeSeeker as AttitudeSeeker
from covocp.blocks.attitude_guidance import constrained as constrained
from covocp.blocks.attitude_guidance import projected as projected
from covocp.blocks.attitude_guidance import unconstrained as unconstrained
from covocp.blocks.attitude_options import Options as Options
from covocp.blocks.zones import Zone as Zone
from covocp.blocks.zones import ZoneLike as ZoneLike
from covocp.blocks.zones import zone as zone
from covocp.blocks.zones import zone_rows as zone_rows
from covocp.blocks.zones import zones_of as zones_of

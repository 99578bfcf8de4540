"""From a statement and a mesh to a nonlinear program: steps, shooting, first guess, starts and scales."""

from covocp.transcription.mesh import Mesh as Mesh
from covocp.transcription.mesh import Options as Options
from covocp.transcription.trajectory import Multipliers as Multipliers
from covocp.transcription.trajectory import Trajectory as Trajectory

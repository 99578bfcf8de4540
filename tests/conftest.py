"""Set before numpy and casadi are loaded, here and in the processes that tests start."""

import os

# Two workers with threads of their own wait for each other's: the matrices are too small to share.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

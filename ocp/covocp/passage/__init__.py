"""The passage of a covariance through Gauss steps and its slopes, compiled; the plain expressions stand beside it."""

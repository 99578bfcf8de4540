"""What flies: laws, controllers, trajectories and solvers as functions with their data."""

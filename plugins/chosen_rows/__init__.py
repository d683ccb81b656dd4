"""Rows chosen anew in each frame, by what was read before: measurement matrices and solvers."""

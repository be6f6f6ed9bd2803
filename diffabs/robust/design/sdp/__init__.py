"""Semidefinite programs of a design: inequalities, scaling and the solver. No other package imports cvxpy."""

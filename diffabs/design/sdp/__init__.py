"""Semidefinite programs of a design: inequalities, scaling, the solver. The only importer of cvxpy."""

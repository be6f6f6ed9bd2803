"""Probabilities of rare failures: subset simulation, importance sampling, design points."""

"""Simulation of a loop: Runge-Kutta steps, event location, single runs and batches, admissibility checks, error
estimates.
"""

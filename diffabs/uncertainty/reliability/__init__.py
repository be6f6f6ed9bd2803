"""Probabilities of rare failures: subset simulation, importance sampling, design points. Needs the extra `sweep`."""

from diffabs.uncertainty.reliability.failure import failure_probability as failure_probability
from diffabs.uncertainty.reliability.importance_sampling import ProbabilityEstimate as ProbabilityEstimate
from diffabs.uncertainty.reliability.subset_simulation import RareEvent as RareEvent
from diffabs.uncertainty.reliability.subset_simulation import subset_simulation as subset_simulation

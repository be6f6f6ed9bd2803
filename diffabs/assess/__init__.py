"""Assess a car by the clauses of a regulation about anti-lock brakes.

    surfaces   roads with a coefficient of adhesion k
    runs       the stops that the clauses ask for, as one batch
    clauses    the figure of each clause, its limit and its verdict

Source: Regulation (EU) 2015/68, Annex XI (anti-lock brakes of agricultural vehicles), read in full; 49 CFR 571.122 for
the time of a rise. That other regulations number their clauses alike was not confirmed.
"""

from diffabs.assess.clauses import Assessment as Assessment
from diffabs.assess.clauses import Clause as Clause
from diffabs.assess.clauses import Figures as Figures
from diffabs.assess.clauses import assess as assess
from diffabs.assess.clauses import clause_figures as clause_figures
from diffabs.assess.runs import RuleStop as RuleStop
from diffabs.assess.runs import StopProgram as StopProgram
from diffabs.assess.runs import plan_stops as plan_stops
from diffabs.assess.runs import run_stops as run_stops
from diffabs.assess.surfaces import make_surface as make_surface
from diffabs.assess.surfaces import peak_friction as peak_friction

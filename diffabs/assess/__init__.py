"""Assess a car by the clauses of a regulation about anti-lock brakes.

    program    what the regulation leaves to the test house
    surfaces   roads with a coefficient of adhesion k
    runs       the stops that the clauses ask for, as one batch
    adhesion   the coefficient of adhesion, measured by braking one axle
    clauses    the figure of each clause, its limit and its verdict
    bounds     clauses as constraints of a tuning

Source: Regulation (EU) 2015/68, Annex XI (anti-lock brakes of agricultural vehicles), read in full; 49 CFR 571.122 for
the time of a rise. That other regulations number their clauses alike was not confirmed.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.assess.adhesion import AxleAdhesion as AxleAdhesion
    from diffabs.assess.adhesion import find_axle_adhesion as find_axle_adhesion
    from diffabs.assess.adhesion import measure_adhesion as measure_adhesion
    from diffabs.assess.bounds import ClauseBounds as ClauseBounds
    from diffabs.assess.clauses import Assessment as Assessment
    from diffabs.assess.clauses import Clause as Clause
    from diffabs.assess.clauses import Figures as Figures
    from diffabs.assess.clauses import assess as assess
    from diffabs.assess.clauses import clause_figures as clause_figures
    from diffabs.assess.clauses import evaluate_clauses as evaluate_clauses
    from diffabs.assess.clauses import judge_clause as judge_clause
    from diffabs.assess.program import StopProgram as StopProgram
    from diffabs.assess.runs import RuleStop as RuleStop
    from diffabs.assess.runs import plan_stops as plan_stops
    from diffabs.assess.runs import run_stops as run_stops
    from diffabs.assess.surfaces import make_surface as make_surface
    from diffabs.assess.surfaces import peak_friction as peak_friction
    from diffabs.assess.surfaces import peak_slip as peak_slip

__getattr__ = lazy_getattr(__name__)

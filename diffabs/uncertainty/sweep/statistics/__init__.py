"""Statistics of a sweep: estimates with intervals, sensitivities, paired comparisons, and the summary."""

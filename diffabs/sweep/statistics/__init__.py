"""What a sweep says: estimates with intervals, sensitivities, paired comparisons, the summary."""

"""The cost of a metre: energy from voltage and current, w v T E, their deviations, and quality bits."""

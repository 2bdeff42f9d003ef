"""Electric power: the rails of a robot, their value at any time, their energy over any span, and how uncertain that is.

Everything that uses power (track columns, label energies, power at a segment's end) follows one rule: a sample of an
averaging source is the mean over the interval that ends at its stamp; other samples are joined by straight lines. Of
several samples at one stamp the first counts.
"""

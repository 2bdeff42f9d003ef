"""Electric power: the rails of a robot, their value at any time, their energy over any span, and how uncertain that is.

One rule for all who ask (the track's columns, a label's energy, the power at its end): a sample of a source that averages is the mean
over the interval that ends at its stamp; any other is joined to its neighbours by a straight line. Of several samples at one stamp the
first counts.
"""

"""What the samples cover, how much of it is independent, how well a label repeats itself, and where to drive next."""

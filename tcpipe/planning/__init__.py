"""Costs of paths, directional cost maps and least-cost paths, by a trained model."""

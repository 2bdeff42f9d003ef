"""Costs of paths, directional cost maps and least-cost paths, by any model that satisfies `cost_model.CostModel`."""

"""What a trained model is for: the cost of a path, directional cost maps, least-cost paths.

Nothing here knows how a model was trained: `cost_model.CostModel` is all that is asked of it.
"""

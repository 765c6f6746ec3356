"""Search for policies: weights are found by playing, without gradients."""

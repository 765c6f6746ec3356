"""The kinds of pools, the arguments by which ``make_pool`` makes each, and what all must do."""

import numpy as np

POOLS = {
    "native": {"backend": "native"},
    "process": {"backend": "auto", "isolation": "process", "workers": 1},
}


def require_same_after_restoring(pool, step):
    """Play actions of two instances from a saved state twice."""
    actions = np.random.default_rng(1).uniform(-1, 1, (12, 2))
    for u in actions[:5]:
        step(pool, u)
    snapshot = pool.save()
    first = [step(pool, u) for u in actions[5:]]
    pool.restore(snapshot)
    np.testing.assert_array_equal(first, [step(pool, u) for u in actions[5:]])

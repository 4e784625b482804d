"""A fitted cost as control reads it, by NumPy."""

import numpy as np


def predicted(model, states):
    """Costs (N, T) of the model."""
    x = np.concatenate([states.z[:, :-1].numpy(), states.actions.numpy()], axis=-1)
    second = np.einsum("nti,tij,ntj->nt", x, model.C[:-1].numpy(), x)
    return 0.5 * second + np.einsum("nti,ti->nt", x, model.c[:-1].numpy()) + model.b[:-1].numpy()


def r2(model, states):
    """Share of the variance of live costs that the model explains."""
    live = states.live.numpy()
    costs, found = states.costs.numpy()[live], predicted(model, states)[live]
    return 1 - np.square(found - costs).sum() / np.square(costs - costs.mean()).sum()

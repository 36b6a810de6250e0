"""How much the particles differ about what each measurement is of."""

import numpy as np

UNSURE = 0.33  # nats: one particle in ten holds something else


def entropy(birth, ancestors):
    """Entropy [C, K], nats, of what each measurement of C frames was taken for.

    `birth` [C, K, N] as `filter.Info`; `ancestors` [C, N]: particles count as often as they go on
    after the frame, which is by their weight wherever they are resampled. Zero where all agree.
    """
    found = np.zeros(birth.shape[:2], np.float32)
    differ = (birth != birth[..., :1]).any(-1)
    for c in np.flatnonzero(differ.any(1)):
        lives = np.bincount(ancestors[c], minlength=birth.shape[2])
        for k in np.flatnonzero(differ[c]):
            _, held = np.unique(birth[c, k], return_inverse=True)
            share = np.bincount(held, lives) / len(lives)
            share = share[share > 0]
            found[c, k] = max(0.0, -np.sum(share * np.log(share)))
    return found
